"""Findings in an EDS file: what is wrong, and where."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class EdsFinding:
    """One finding.

    Attributes:
        line: number of the line, from 1; 0 where it concerns the whole file.
        section: name of the section, without brackets; empty outside any section.
        key: key in the spelling of the standard; empty where the finding concerns the section.
        text: what is wrong, and for a warning what was taken instead.
        prevents: whether it prevents serving; else it is a warning.
    """

    line: int
    section: str
    key: str
    text: str
    prevents: bool

    def __str__(self) -> str:
        where = f"line {self.line}" if self.line else "whole file"
        section = f" [{self.section}]" if self.section else ""
        return f"{where}{section}{f' {self.key}' if self.key else ''}: {self.text}"


@dataclass(slots=True)
class EdsFindings:
    """Collects findings while a file is read."""

    found: list[EdsFinding] = field(default_factory=list)

    def fault(self, line: int, section: str, key: str, text: str) -> None:
        """Add a fault: it cannot be known what the device would answer."""
        self.found.append(EdsFinding(line, section, key, text, True))

    def warn(self, line: int, section: str, key: str, text: str) -> None:
        """Add a warning: the meaning is clear, or the rest can be served."""
        self.found.append(EdsFinding(line, section, key, text, False))

    def sorted(self) -> tuple[EdsFinding, ...]:
        """All findings, by line."""
        return tuple(sorted(self.found, key=lambda fault: fault.line))
