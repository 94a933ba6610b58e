"""An operator at the terminal: questions on stderr, answers from stdin, without ever waiting for one."""

from __future__ import annotations

import os
import select
import sys

from canprobe.cell.tasks.joint_finding import Answer
from canprobe.cli.progress import say

_CHOICES = "Enter or y: yes, n: no, q: end"
_WORDS = {"": Answer.YES, "y": Answer.YES, "yes": Answer.YES, "n": Answer.NO, "no": Answer.NO, "q": Answer.QUIT}
_LOOK_EVERY = 20
"""Cycles between two looks at the terminal: each costs a system call."""


class LetterKey:
    """A letter and Enter on stdin, where that is a terminal.

    Args:
        letter: the letter.
    """

    def __init__(self, letter: str) -> None:
        self._letter = letter
        self._descriptor = sys.stdin.fileno() if sys.stdin.isatty() else None
        self._left = 0

    def pressed(self) -> bool:
        """Whether a line of this letter was typed since the last look. Called in each cycle."""
        self._left -= 1
        if self._descriptor is None or self._left > 0:
            return False
        self._left = _LOOK_EVERY
        typed = b""
        while select.select([self._descriptor], [], [], 0)[0]:
            data = os.read(self._descriptor, 4096)
            if not data:
                self._descriptor = None
                break
            typed += data
        return self._letter in (line.strip().lower() for line in typed.decode(errors="replace").splitlines())


class TerminalOperator:
    """Reads whole lines from a file descriptor.

    Args:
        descriptor: file descriptor of a terminal or pipe; stdin by default. At its end the answer is `QUIT`.
    """

    def __init__(self, descriptor: int | None = None) -> None:
        self._descriptor = sys.stdin.fileno() if descriptor is None else descriptor
        self._text = b""
        self._left = 0

    def ask(self, question: str) -> None:
        """Ask a question; lines typed before it are ignored."""
        self._read()
        self._text = b""
        self._left = 0
        say(f"{question} [{_CHOICES}]")

    def answer(self) -> Answer | None:
        """The answer in the next whole line; after an unknown word it asks again."""
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
        """Read the available text; False at the end of the file."""
        while select.select([self._descriptor], [], [], 0)[0]:
            data = os.read(self._descriptor, 4096)
            if not data:
                return bool(self._text)
            self._text += data
        return True
