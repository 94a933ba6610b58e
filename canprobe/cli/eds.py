"""`canprobe eds`: the packaged EDS files, for other tools and masters."""

from __future__ import annotations

import argparse
from importlib import resources
from pathlib import Path

from canprobe.cli.output import print_json
from canprobe.cli.parser import Commands, Parser, add_json, did_you_mean
from canprobe.errors import EdsError

_EXAMPLE = """\
examples:
  canprobe eds list
  canprobe eds path puma260_joint.eds
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "eds", help="list the EDS files or show where they are", description=__doc__, epilog=_EXAMPLE
    )
    actions = parser.add_subparsers(metavar="ACTION", required=True, parser_class=Parser)
    listing = actions.add_parser("list", help="list the packaged files", epilog="example:\n  canprobe eds list\n")
    add_json(listing)
    listing.set_defaults(run=run, action="list")
    path = actions.add_parser(
        "path", help="print where one of them is", epilog="example:\n  canprobe eds path puma260_joint.eds\n"
    )
    path.add_argument("name", metavar="NAME", help="name of a packaged file, with or without .eds")
    path.set_defaults(run=run, action="path")


def run(args: argparse.Namespace) -> int:
    """Print the names of the files, or the path of one."""
    files = {path.name: path for path in sorted(Path(str(resources.files("canprobe.eds"))).glob("*.eds"))}
    if args.action == "path":
        print(_find(args.name, files))
    elif args.json:
        print_json(sorted(files))
    else:
        print("\n".join(sorted(files)))
    return 0


def _find(name: str, files: dict[str, Path]) -> Path:
    wanted = name if name.endswith(".eds") else f"{name}.eds"
    if wanted not in files:
        raise EdsError(
            f"{name}: no such packaged EDS{did_you_mean(wanted, files)}; there are: {', '.join(sorted(files))}"
        )
    return files[wanted]
