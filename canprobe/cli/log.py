"""`canprobe log`: convert a recorded bus between candump, BLF, ASC and TRC."""

from __future__ import annotations

import argparse
from pathlib import Path

from canprobe.cli.parser import Commands, Parser
from canprobe.errors import UsageError

_EXAMPLE = """\
The suffix names the form: .log for candump, .blf for Vector's tools, .asc, .trc.

examples:
  canprobe log runs/cylinder-20260101-120000-000 --to run.blf
  canprobe log recorded.blf --to recorded.log
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser("log", help="convert a recorded bus", description=__doc__, epilog=_EXAMPLE)
    parser.add_argument("log", metavar="LOG", type=Path, help="folder of a run, or a log file")
    parser.add_argument("--to", metavar="FILE", type=Path, required=True, help="the file to write")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Convert, and say how many frames there were."""
    source = args.log / "bus.log" if args.log.is_dir() else args.log
    if not source.is_file():
        raise UsageError(f"{source}: no such log")

    from canprobe.bus.disk import convert_log

    print(f"{args.to}: {convert_log(source, args.to)} frames")
    return 0
