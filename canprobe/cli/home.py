"""Home the joints with `zero = "homing"`: each drive finds its zero, one after the other, and stops safely.

Asks before each joint. A zero is recorded beside the cell file, and holds as long as the drive is not switched off.
"""

from __future__ import annotations

import argparse

from canprobe.cli.argument_types import whole
from canprobe.cli.hands import add_arguments_of_hands
from canprobe.cli.parser import Parser
from canprobe.cli.stdin import need_terminal
from canprobe.cli.target import scene_of

HELP = "home the joints whose drives have no absolute encoder"
EXAMPLE = """\
examples:
  canprobe home cell.toml --dry-run
  canprobe home cell.toml --bus socketcan --channel can0
  canprobe home cell.toml 3 4 --bus socketcan --channel can0 --yes
"""


def add_arguments(parser: Parser) -> None:
    parser.add_shared("SCENE")
    parser.add_argument(
        "joints", metavar="JOINT", nargs="*", type=whole(1, 99), help="numbers of joints, from 1 [all that are homed]"
    )
    parser.add_option("--dry-run", "show how each joint would be homed, and move nothing")
    add_arguments_of_hands(parser)


def run(args: argparse.Namespace) -> None:
    """Home joint by joint."""
    need_terminal(args.yes or args.dry_run, "home asks before each joint")
    scene = scene_of(args)

    from canprobe import api
    from canprobe.cli.operator import NobodyMoves, TerminalOperator

    operator = NobodyMoves() if args.dry_run else None if args.yes else TerminalOperator()
    api.home(scene, args.joints or None, operator=operator, say=args.report.say)
