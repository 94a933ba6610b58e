"""Judge link and machine of a cell before anything moves: fit, marginal or unfit for the rate of its plan, and why.

The cell is configured as for a run, cycles with its drives disabled, and every node is left as it was found. Nothing is
sent beside another master, nor to a drive under power.
"""

from __future__ import annotations

import argparse

from canprobe.cli.argument_types import seconds
from canprobe.cli.parser import Parser
from canprobe.cli.target import scene_of

HELP = "judge link and machine before motion"
EXAMPLE = """\
exit status: 0 fit, 1 marginal or unfit, 3 no node or no interface

examples:
  canprobe check free --bus socketcan --channel can0
  canprobe check cell.toml --bus socketcan --channel can0 --seconds 30 --realtime
  canprobe check free --json
"""


def add_arguments(parser: Parser) -> None:
    parser.add_shared("SCENE", "BUS", "--realtime", "--patient")
    parser.add_option("--seconds S", "length of the measurement [10]", seconds, default=10.0)
    parser.add_shared("--json", "-v")


def run(args: argparse.Namespace) -> int:
    """Print the report; the status is the verdict."""
    scene = scene_of(args)

    from canprobe import api
    from canprobe.cli.output import print_answer

    report = api.check(scene, seconds=args.seconds, say=args.report.say)
    print_answer(args, report.as_document(), report.text())
    return 0 if report.fit else 1
