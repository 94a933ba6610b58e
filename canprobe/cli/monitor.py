"""Watch a running cell: nodes, joints, force, taxels, bus load and jitter of SYNC. Nothing is sent.

On a terminal the display is renewed ten times a second. Elsewhere one report is printed after a second.
"""

from __future__ import annotations

import argparse
import sys

from canprobe.cli.argument_types import seconds
from canprobe.cli.output import print_json
from canprobe.cli.parser import Parser
from canprobe.cli.target import loaded, target_of
from canprobe.fieldbus.bus.real.interrupts import Terminated

HELP = "watch a running cell"
EXAMPLE = """\
examples:
  canprobe monitor cylinder --bus socketcan --channel can0
  canprobe monitor cylinder --bus socketcan --channel can0 --duration 2 --json
  canprobe monitor two.toml --bus socketcan --channel arm=can0 --channel sensor=can1
"""


def add_arguments(parser: Parser) -> None:
    parser.add_shared("SCENE", "BUS")
    parser.add_option("--duration S", "end after S seconds [at Ctrl-C on a terminal, else 1]", seconds)
    parser.add_shared("--json", "-v")


def run(args: argparse.Namespace) -> None:
    """Show the cell ten times a second; with --json print it once, at the end."""
    scene = loaded(args)
    scene = target_of(args, scene).applied_to(scene)

    from canprobe import api
    from canprobe.cell.master.monitor import lines, screen

    on_terminal = sys.stdout.isatty() and not args.json
    duration_s = args.duration if args.duration is not None or on_terminal else 1.0
    view, ended = None, None
    try:
        for view in api.monitor(scene, duration_s=duration_s, say=args.report.say):
            if on_terminal:
                sys.stdout.write(screen(view))
                sys.stdout.flush()
    except KeyboardInterrupt as interrupt:
        ended = interrupt
    if args.json and view is not None:
        print_json(view.as_document())
    elif not on_terminal and view is not None:
        print("\n".join(lines(view)))
    if isinstance(ended, Terminated):
        raise ended
