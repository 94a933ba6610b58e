"""A point of the examination."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from canprobe.fieldbus.tools.conform import accepted
from canprobe.fieldbus.tools.conform.pdo_bench import PdoBench

HINTS = tomllib.loads(Path(__file__).with_name("hints.toml").read_text(encoding="utf-8"))
"""What the author of a firmware can look at where a point fails, by its number."""


@dataclass(frozen=True, eq=False, slots=True)
class Point:
    """One point of the examination.

    Attributes:
        number: number in the list of points; several points of one subject may share it.
        group: service that it examines, such as ``sdo``.
        name: short name, the same from run to run.
        clause: clause of the standard.
        expected: what is accepted, in words.
        run: function that examines it: it returns where the device conforms, else raises an error of `outcome`.
        needs: what must be there: ``eds``, ``nmt`` (no other master), ``sync`` (no other SYNC producer), ``alone`` (no
            other node), ``stamps`` (late by 10 ms at most), ``drive``, ``motion`` (permission to switch the power
            stage on).
        hint: what the author of a firmware can look at.
    """

    number: int
    group: str
    name: str
    clause: str
    expected: str
    run: Callable[[PdoBench], None]
    needs: frozenset[str] = frozenset()
    hint: str = ""

    @property
    def title(self) -> str:
        """Number and name, by which reports know the point."""
        return f"{self.number} {self.name}"


@dataclass(frozen=True, slots=True)
class PointGroup:
    """Makes the points of one service, as a decorator of the functions that examine them.

    Attributes:
        name: name of the group, such as ``sdo``.
        standard: standard of its clauses, such as ``CiA 301``; empty where each clause names its own.
        needs: what all its points need.
    """

    name: str
    standard: str = ""
    needs: str = ""

    def __call__(
        self, number: int, name: str, clause: str, expected: str | accepted.AbortSet, *, needs: str = ""
    ) -> Callable[[Callable[[PdoBench], None]], Point]:
        """Make a `Point` of the function below; `expected` are words or codes, `needs` are words with blanks."""
        text = expected if isinstance(expected, str) else accepted.text(expected)
        source = f"{self.standard}, {clause}" if self.standard else clause
        all_needs, hint = frozenset(f"{self.needs} {needs}".split()), HINTS[str(number)]
        return lambda run: Point(number, self.name, name, source, text, run, all_needs, hint)
