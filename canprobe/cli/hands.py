"""Parts of the commands that move an arm by hand: the question before it, and what ends a motion."""

from __future__ import annotations

import argparse
import contextlib
import os
import select
import stat
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from canprobe.cli.common_arguments import BUS, add_options, add_verbosity
from canprobe.cli.parser import Parser
from canprobe.cli.target import scene_of
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.clock import MonotonicClock, elapsed_ns

if TYPE_CHECKING:
    from canprobe.cell.results.open_cell import OpenCell
    from canprobe.cell.scene.model import Scene

LOOK_S = 0.02
"""Time between two looks at the terminal, s."""
ROWS = 4000
"""Cycles whose rows are kept."""


def add_arguments_of_hands(parser: Parser, *more: str) -> None:
    """Add the options of a command that moves an arm."""
    add_options(parser, *BUS, "--realtime", "--patient", *more)
    parser.add_argument("--yes", action="store_true", help="do not ask before the motion")
    add_verbosity(parser)
    parser.set_defaults(asking=parser.prog.removeprefix("canprobe "))


def opened(args: argparse.Namespace, prepared: Callable[[Scene], Scene] = lambda scene: scene) -> OpenCell:
    """The cell of a command; a question needs somebody who answers.

    Args:
        args: the command line.
        prepared: changes the scene.

    Raises:
        UsageError: neither a terminal nor --yes.
    """
    if not getattr(args, "yes", True) and not sys.stdin.isatty():
        raise UsageError(f"{args.asking} asks before the motion and needs a terminal; --yes leaves that out")

    from canprobe import api

    return api.open_cell(prepared(scene_of(args)), say=args.report.say, rows_kept=ROWS)


def agreed(args: argparse.Namespace, cell: OpenCell, question: str) -> bool:
    """Whether the person says yes; the nodes are kept awake meanwhile."""
    if args.yes:
        return True
    from canprobe.cell.tasks.joint_finding import Answer
    from canprobe.cli.operator import TerminalOperator

    operator, clock = TerminalOperator(), MonotonicClock()
    operator.ask(question)
    while (answer := operator.answer()) is None:
        cell.cell.idle(LOOK_S)
        if cell.session.virtual:
            clock.sleep_until_ns(clock.now_ns() + round(1e9 * LOOK_S))
    return answer is Answer.YES


class InputOpen:
    """Whether stdin is open, for a script whose end ends its motion.

    A terminal that is closed sends SIGHUP, and a file or /dev/null has no end that means something: a pipe is watched,
    if it is open at the beginning.
    """

    def __init__(self) -> None:
        self._look_ns = 0
        self.watched = False
        with contextlib.suppress(OSError):  # no stdin at all
            self._descriptor = sys.stdin.fileno()
            mode = os.fstat(self._descriptor).st_mode
            self.watched = (stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)) and self._has_more()

    def __call__(self) -> bool:
        if self.watched and (now_ns := elapsed_ns()) >= self._look_ns:
            self._look_ns = now_ns + round(1e9 * LOOK_S)
            self.watched = self._has_more()
            return self.watched
        return True

    def _has_more(self) -> bool:
        """Whether it is open; what was written into it is read."""
        while select.select([self._descriptor], [], [], 0)[0]:
            if not os.read(self._descriptor, 4096):
                return False
        return True
