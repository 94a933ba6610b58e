"""One EDS file while it is read: its sections, and the findings so far. All builders of a dictionary share it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from canprobe.fieldbus.eds.findings import EdsFindings
from canprobe.fieldbus.eds.numbers import parse_integer
from canprobe.fieldbus.eds.sections import Section, Sections


@dataclass(frozen=True, slots=True)
class Source:
    """An EDS file in pieces.

    Attributes:
        sections: sections of the file.
        node_id: value of $NODEID.
        faults: findings so far.
        drive: whether the device is a drive of CiA 402.
    """

    sections: Sections
    node_id: int
    faults: EdsFindings
    drive: bool = False

    def warn(self, section: Section, key: str, text: str) -> None:
        """Add a warning at a key, or at its section where the key is missing."""
        self.faults.warn(section.line_of(key), section.name, key, text)

    def fault(self, section: Section, key: str, text: str) -> None:
        """Add a fault at a key, or at its section where the key is missing."""
        self.faults.fault(section.line_of(key), section.name, key, text)

    def remark(self, section: Section, key: str) -> Callable[[str], None]:
        """The function that a parser calls with a remark on the value of a key."""
        return lambda text: self.warn(section, key, text)

    def number(self, section: Section, key: str, default: int = 0) -> int:
        """Integer that does no harm when it is wrong; `default` where it is missing, empty or not a number."""
        text = section.value(key)
        if not text:
            return default
        try:
            return parse_integer(text, self.remark(section, key))
        except ValueError as error:
            self.warn(section, key, f"{error}; read as {default}")
            return default
