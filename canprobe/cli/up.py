"""Bring the cell up, hold and supervise it until Ctrl-C, then stop it safely.

The drives hold their positions. A SocketCAN interface is checked before anything is sent.
"""

from __future__ import annotations

import argparse
import os
import select
import sys

from canprobe.cli.output import left_by_ctrl_c, say
from canprobe.cli.parser import BUS, Parser, add_options, add_scene, scene_of
from canprobe.errors import UsageError
from canprobe.tasks.untouched import Answer

HELP = "bring the cell up and hold it"
EXAMPLE = """\
examples:
  canprobe up free --bus socketcan --channel can0
  canprobe up free --bus socketcan --channel can0 --check-joints
"""


def add_arguments(parser: Parser) -> None:
    """Add the command's arguments."""
    add_scene(parser)
    add_options(parser, *BUS, "--realtime", "--patient", "--bridge")
    parser.add_argument(
        "--check-joints",
        action="store_true",
        help="turn one joint after the other by 1 deg and back, compare the encoders, and end; asks before each motion",
    )
    parser.add_argument("--yes", action="store_true", help="with --check-joints: do not ask")


def run(args: argparse.Namespace) -> int:
    """Hold the cell until Ctrl-C, which is the normal way to leave."""
    if args.yes and not args.check_joints:
        raise UsageError("up: --yes goes with --check-joints")
    if args.bridge and args.check_joints:
        raise UsageError("up: --check-joints feeds no --bridge")
    scene = scene_of(args)
    if args.check_joints and not args.yes and not sys.stdin.isatty():
        raise UsageError("up --check-joints asks before each motion and needs a terminal; --yes leaves that out")

    from canprobe import api

    if args.check_joints:
        api.check_joints(scene, operator=None if args.yes else TerminalOperator(), say=say)
        return 0
    with left_by_ctrl_c():
        api.up(scene, bridge=args.bridge, say=say)
    return 0


# The operator of `--check-joints`: questions on stderr, answers from stdin, without ever waiting for one.

_CHOICES = "Enter or y: yes, n: no, q: end"
_WORDS = {"": Answer.YES, "y": Answer.YES, "yes": Answer.YES, "n": Answer.NO, "no": Answer.NO, "q": Answer.QUIT}
_LOOK_EVERY = 20
"""Cycles between two looks at the terminal: each costs a system call."""


class TerminalOperator:
    """Reads whole lines from a file descriptor.

    Args:
        descriptor: of a terminal or pipe; stdin by default. At its end the answer is `QUIT`.
    """

    def __init__(self, descriptor: int | None = None) -> None:
        self._descriptor = sys.stdin.fileno() if descriptor is None else descriptor
        self._text = b""
        self._left = 0

    def ask(self, question: str) -> None:
        """Put a question; what was typed before it is no answer to it."""
        self._read()
        self._text = b""
        self._left = 0
        say(f"{question} [{_CHOICES}]")

    def answer(self) -> Answer | None:
        """What the next whole line says; one that says nothing is asked for again."""
        self._left -= 1
        if self._left > 0:
            return None
        self._left = _LOOK_EVERY
        if not self._read():
            return Answer.QUIT
        line, newline, rest = self._text.partition(b"\n")
        if not newline:
            return None
        self._text = rest
        answer = _WORDS.get(line.decode(errors="replace").strip().lower())
        if answer is None:
            say(f"[{_CHOICES}]")
        return answer

    def _read(self) -> bool:
        """Take what is there; False at the end of the file."""
        while select.select([self._descriptor], [], [], 0)[0]:
            data = os.read(self._descriptor, 4096)
            if not data:
                return bool(self._text)
            self._text += data
        return True
