"""Take what the array shows for zero. Nothing may touch it; drives stay disabled.

Bring-up tares the array in each run. This shows what a tare does: the force and the highest taxel before and after.
"""

from __future__ import annotations

import argparse

from canprobe.cli.hands import add_arguments_of_hands, agreed, opened
from canprobe.cli.listen import array_line, array_only
from canprobe.cli.parser import Parser

HELP = "take what the array shows for zero"
EXAMPLE = """\
examples:
  canprobe tare puma260
  canprobe tare cell.toml --bus socketcan --channel can0
"""


def add_arguments(parser: Parser) -> None:
    parser.add_shared("SCENE")
    add_arguments_of_hands(parser)


def run(args: argparse.Namespace) -> None:
    """Show the image, ask, tare, and show it again."""
    with opened(args, prepared=array_only) as cell:
        print(f"before: {array_line(cell, cell.read())}")
        if not agreed(args, cell, "is the array free, and may this be zero?"):
            args.report.say("nothing was tared")
            return
        cell.tare()
        print(f"after:  {array_line(cell, cell.read())}")
