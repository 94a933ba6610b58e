"""What is wrong in an EDS file, and where."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class EdsFinding:
    """One thing that is wrong.

    Attributes:
        line: in the file, from 1; 0 where it concerns the whole file.
        section: without brackets; empty outside any.
        key: as the standard writes it; empty where it concerns the section.
        text: what is wrong, and for a warning what was taken instead.
        prevents: the file cannot be served as it is; False makes it a warning.
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
        """What the device would answer cannot be known."""
        self.found.append(EdsFinding(line, section, key, text, True))

    def warn(self, line: int, section: str, key: str, text: str) -> None:
        """Not as it should be, but the meaning is clear or the rest can be served."""
        self.found.append(EdsFinding(line, section, key, text, False))

    def sorted(self) -> tuple[EdsFinding, ...]:
        """By line."""
        return tuple(sorted(self.found, key=lambda fault: fault.line))
