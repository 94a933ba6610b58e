"""Bring the cell up, hold and supervise it until Ctrl-C, then stop it safely.

The drives hold their positions. A SocketCAN interface is checked before anything is sent.
"""

from __future__ import annotations

import argparse
from typing import Any

from canprobe.cli.interrupts import left_by_ctrl_c
from canprobe.cli.parser import Parser
from canprobe.cli.stdin import need_terminal
from canprobe.cli.target import scene_of
from canprobe.errors import UsageError

HELP = "bring the cell up and hold it"
EXAMPLE = """\
examples:
  canprobe up free --bus socketcan --channel can0
  canprobe up free --bus socketcan --channel can0 --check-joints
  canprobe up free --bus socketcan --channel can0 --recover
"""


def add_arguments(parser: Parser) -> None:
    parser.add_shared("SCENE", "BUS", "--realtime", "--patient", "--bridge")
    parser.add_option(
        "--check-joints",
        "move one joint after the other by 1 deg and by 10 deg (3.5 and 35 mm for a sliding joint) and back,"
        " compare the encoders and what you see, record it, and end; asks before each motion",
    )
    parser.add_option(
        "--recover",
        "come back after a node was switched off or reset, or the interface was down: stop, wait, bring up again"
        " and hold; `r` and Enter let requested motion go on",
    )
    parser.add_option("--yes", "with --check-joints: do not ask; by 10 deg nothing moves then")
    parser.add_shared("-v")


def run(args: argparse.Namespace) -> None:
    """Hold the cell until Ctrl-C, which is the normal way to leave."""
    if args.yes and not args.check_joints:
        raise UsageError("up: --yes goes with --check-joints")
    if args.bridge and args.check_joints:
        raise UsageError("up: --check-joints feeds no --bridge")
    if args.recover and args.check_joints:
        raise UsageError("up: --check-joints moves joints with somebody beside it; leave out --recover")

    from canprobe import api
    from canprobe.cli.operator import LetterKey, TerminalOperator

    scene = scene_of(args)
    if args.check_joints:
        need_terminal(args.yes, "up --check-joints asks before each motion")
        api.check_joints(scene, operator=None if args.yes else TerminalOperator(), say=args.report.say)
        return
    with left_by_ctrl_c():
        back: dict[str, Any] = {"recover": True, "asked": LetterKey("r").pressed} if args.recover else {}
        api.up(scene, bridge=args.bridge, say=args.report.say, **back)
