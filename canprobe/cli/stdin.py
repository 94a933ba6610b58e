"""Stdin of a command: somebody who answers, or a pipe whose end ends a motion."""

from __future__ import annotations

import contextlib
import os
import stat
import sys

from canprobe.cli.output import say
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.clock import elapsed_ns
from canprobe.fieldbus.bus.system import system

LOOK_S = 0.02
"""Time between two looks at the terminal, s."""


def need_terminal(yes: bool, asks: str) -> None:
    """Refuse a command that asks where nobody can answer.

    Args:
        yes: nothing is asked.
        asks: the command, and before what it asks: "move asks before the motion".

    Raises:
        UsageError: stdin is no terminal.
    """
    if not yes and not sys.stdin.isatty():
        raise UsageError(f"{asks} and needs a terminal; --yes leaves that out")


def yes_typed(question: str) -> bool:
    """Ask at the terminal; only yes is yes."""
    say(f"{question} [yes or no]")
    return sys.stdin.readline().strip().lower() in ("y", "yes")


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
            self.watched = (stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode)) and system.typed(self._descriptor)[1]

    def __call__(self) -> bool:
        if self.watched and (now_ns := elapsed_ns()) >= self._look_ns:
            self._look_ns = now_ns + round(1e9 * LOOK_S)
            self.watched = system.typed(self._descriptor)[1]
            return self.watched
        return True
