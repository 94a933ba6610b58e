"""A report: its rows, and what stands round them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from enum import StrEnum


class Verdict(StrEnum):
    """Verdict on one point or rule."""

    PASS = "PASS"
    FAIL = "FAIL"
    NOT_APPLICABLE = "NOT APPLICABLE"
    ERROR = "ERROR"


class Severity(StrEnum):
    """What a finding costs, worst first; a row without one has an empty text."""

    UNSAFE = "unsafe"
    WRONG = "wrong"
    REFUSED = "refused"
    MINOR = "minor"


IDENTITY = ("vendor", "product", "revision", "serial", "device name", "hardware version", "firmware")
"""Facts of a report that name the device: 1018h:01 to :04, 1008h, 1009h, 100Ah."""


@dataclass(frozen=True, slots=True)
class ReportRow:
    """One point or rule, and what came of it.

    Attributes:
        group: group of the point, such as ``sdo``.
        name: number and name, such as ``10 write ro``; the same from run to run.
        verdict: the verdict.
        clause: clause of the standard, or source of the rule.
        expected: what is accepted, in words.
        sent: frames that were sent, decoded and in hex.
        came: frames that came, decoded and in hex.
        detail: what was wrong, or why the point does not apply, in one sentence.
        hint: what the reader can do about it.
        severity: a `Severity`; empty where nothing was found.
        written: objects that were written, and whether they were restored.
        seconds: time that the point took, s.
    """

    group: str
    name: str
    verdict: Verdict
    clause: str = ""
    expected: str = ""
    sent: tuple[str, ...] = ()
    came: tuple[str, ...] = ()
    detail: str = ""
    hint: str = ""
    severity: str = ""
    written: tuple[str, ...] = ()
    seconds: float = 0.0

    @property
    def key(self) -> str:
        """Group and name, by which reports are compared."""
        return f"{self.group} {self.name}"


@dataclass(slots=True)
class Report:
    """A report, which grows while its tool works.

    Attributes:
        tool: ``conform`` or ``judge``.
        title: what was examined, in one line.
        facts: device (the names of `IDENTITY`), hash of the EDS, and bench: adapter, bit rate, versions, seed, command.
        rows: the rows in the order of their verdicts.
        left_out: what was not examined, and why.
        manual: steps for a person.
        distributions: measured times by name, ms.
        log: path of the recorded frames; None where they were not kept.
        known: keys of rows that failed in the baseline too, and may fail.
    """

    tool: str
    title: str
    facts: dict[str, str] = field(default_factory=dict)
    rows: list[ReportRow] = field(default_factory=list)
    left_out: list[tuple[str, str]] = field(default_factory=list)
    manual: list[str] = field(default_factory=list)
    distributions: dict[str, tuple[float, ...]] = field(default_factory=dict)
    log: str | None = None
    known: tuple[str, ...] = ()

    def counts(self) -> dict[Verdict, int]:
        """Number of rows of each verdict, zeros included."""
        counted = Counter(row.verdict for row in self.rows)
        return {verdict: counted[verdict] for verdict in Verdict}

    def groups(self) -> dict[str, list[ReportRow]]:
        """Rows by group, both in the order in which they came."""
        groups: dict[str, list[ReportRow]] = {}
        for row in self.rows:
            groups.setdefault(row.group, []).append(row)
        return groups

    @property
    def bad(self) -> list[ReportRow]:
        """Rows that failed or were not examined."""
        return [row for row in self.rows if row.verdict in (Verdict.FAIL, Verdict.ERROR)]

    @property
    def exit_status(self) -> int:
        """Exit status of the tool: 1 where a row failed that may not, else 3 where one was not examined, else 0."""
        failed = any(row.verdict is Verdict.FAIL and row.key not in self.known for row in self.rows)
        return 1 if failed else 3 if self.counts()[Verdict.ERROR] else 0


def printable(text: str) -> str:
    """The text with its control characters and lone surrogates escaped; line ends and tabs stay.

    A device may report any byte as its name: XML refuses most control characters, and a terminal obeys them.
    """
    plain = (char if char in "\n\t" or char.isprintable() else char.encode("unicode_escape").decode() for char in text)
    return "".join(plain)
