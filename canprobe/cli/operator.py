"""An operator at the terminal: questions on stderr, answers from stdin, without ever waiting for one."""

from __future__ import annotations

import re
import sys

from canprobe.cell.tasks.joint_check import Answer, SeenWay
from canprobe.cli.output import say
from canprobe.fieldbus.bus.system import system

_CHOICES = {False: "Enter or y: yes, n: no, q: end", True: "a number, Enter or y: just so, n: otherwise, q: end"}
"""The choices of a question, by whether it asks for a way."""
_WAY = re.compile(r"([+-]?\d+(?:[.,]\d*)?) ?(deg|mm)?")
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
        self.pressed()  # what was typed before

    def pressed(self) -> bool:
        """Whether a line of this letter was typed since the last look. Called in each cycle."""
        self._left -= 1
        if self._descriptor is None or self._left > 0:
            return False
        self._left = _LOOK_EVERY
        lines, is_open = system.typed(self._descriptor)
        if not is_open:
            self._descriptor = None
        return self._letter in (line.strip().lower() for line in lines.decode(errors="replace").splitlines())


class NobodyMoves:
    """An operator who reads each question, and says no."""

    def ask(self, question: str, *, for_way: bool = False) -> None:
        """Print what would be done."""
        print(question.removesuffix("?"))

    def answer(self) -> Answer:
        """No."""
        return Answer.NO


class TerminalOperator:
    """Reads whole lines from a file descriptor.

    Args:
        descriptor: file descriptor of a terminal or pipe; stdin by default. At its end the answer is `QUIT`.
    """

    def __init__(self, descriptor: int | None = None) -> None:
        self._descriptor = sys.stdin.fileno() if descriptor is None else descriptor
        self._text = b""
        self._left = 0
        self._for_way = False

    def ask(self, question: str, *, for_way: bool = False) -> None:
        """Ask a question; lines typed before it are ignored."""
        self._read()
        self._text = b""
        self._left, self._for_way = 0, for_way
        say(f"{question} [{_CHOICES[for_way]}]")

    def answer(self) -> Answer | SeenWay | None:
        """The answer in the next whole line, or in what the end of the file left of one; an unknown word asks again."""
        self._left -= 1
        if self._left > 0:
            return None
        self._left = _LOOK_EVERY
        is_open = self._read()
        line, newline, rest = self._text.partition(b"\n")
        if not newline and is_open:
            return None
        if not (newline or line):
            return Answer.QUIT
        self._text = rest
        word = line.decode(errors="replace").strip().lower()
        if self._for_way and (way := _WAY.fullmatch(word.replace("°", "deg"))) is not None:
            return SeenWay(float(way[1].replace(",", ".")), way[2], way[1][0] in "+-")
        if (answer := _WORDS.get(word)) is None:
            say(f"[{_CHOICES[self._for_way]}]")
        return answer

    def _read(self) -> bool:
        """Read the available text; False at the end of the file."""
        text, is_open = system.typed(self._descriptor)
        self._text += text
        return is_open
