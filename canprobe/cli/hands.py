"""Parts of the commands that move an arm by hand: the question before it, and the cell of a command."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from canprobe.cli.parser import Parser
from canprobe.cli.stdin import LOOK_S, need_terminal
from canprobe.cli.target import scene_of
from canprobe.fieldbus.bus.clock import MonotonicClock

if TYPE_CHECKING:
    from canprobe.cell.results.open_cell import OpenCell
    from canprobe.cell.scene.model import Scene

ROWS = 4000
"""Cycles whose rows are kept."""


def add_arguments_of_hands(parser: Parser) -> None:
    """Add the options of a command that moves an arm."""
    parser.add_shared("BUS", "--realtime", "--patient")
    parser.add_option("--yes", "do not ask before the motion")
    parser.add_shared("-v")
    parser.set_defaults(asking=parser.prog.removeprefix("canprobe "))


def opened(args: argparse.Namespace, prepared: Callable[[Scene], Scene] = lambda scene: scene) -> OpenCell:
    """The cell of a command; a question needs somebody who answers.

    Args:
        args: the command line.
        prepared: changes the scene.

    Raises:
        UsageError: neither a terminal nor --yes.
    """
    if "asking" in args:
        need_terminal(args.yes, f"{args.asking} asks before the motion")

    from canprobe import api

    return api.open_cell(prepared(scene_of(args)), say=args.report.say, rows_kept=ROWS)


def agreed(args: argparse.Namespace, cell: OpenCell, question: str) -> bool:
    """Whether the person says yes; the nodes are kept awake meanwhile."""
    if args.yes:
        return True
    from canprobe.cell.tasks.joint_check import Answer
    from canprobe.cli.operator import TerminalOperator

    operator, clock = TerminalOperator(), MonotonicClock()
    operator.ask(question)
    while (answer := operator.answer()) is None:
        cell.cell.idle(LOOK_S)
        if cell.session.virtual:
            clock.sleep_until_ns(clock.now_ns() + round(1e9 * LOOK_S))
    return answer is Answer.YES
