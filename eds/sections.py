"""Splits the bytes of an EDS file into sections and keys, each with its line, and reports what is wrong with them.

The file is read as Windows reads an INI file, as the tools of vendors do: names count in any case, and of two equal
names the first one counts. Source: CiA 306-1, "General structure".
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

from canprobe.fieldbus.eds.findings import EdsFindings
from canprobe.fieldbus.eds.numbers import Remark, parse_integer

T = TypeVar("T")
LINE_END_PATTERN = re.compile(r"\r\n|\n|\r")
_COMMENT_PATTERN = re.compile(r"\s;.*")
_UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


@dataclass(frozen=True, slots=True)
class Item:
    """One `key=value`; the value is without blanks and quotes around it, and without a comment behind it."""

    key: str
    value: str
    line: int


@dataclass(slots=True)
class Section:
    """One section.

    Attributes:
        name: name in the spelling of the file, without the brackets.
        line: number of the line of its head.
        items: keys and values, by key in lower case.
    """

    name: str
    line: int
    items: dict[str, Item] = field(default_factory=dict)

    def value(self, key: str) -> str:
        """Value of a key; empty where the key is missing."""
        item = self.items.get(key.lower())
        return "" if item is None else item.value

    def line_of(self, key: str) -> int:
        """Line of a key, or of the section where the key is missing."""
        item = self.items.get(key.lower())
        return self.line if item is None else item.line


Sections = dict[str, Section]
"""Sections by name in lower case, in the order of the file."""


@dataclass(frozen=True, slots=True)
class Source:
    """One EDS file while it is read: its sections, and the findings so far. All builders of a dictionary share it.

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

    def remark(self, section: Section, key: str) -> Remark:
        """The function that a parser calls with a remark on the value of a key."""
        return lambda text: self.warn(section, key, text)

    def read(self, section: Section, key: str, parse: Callable[[str, Remark], T], default: T, wrong: str) -> T:
        """Value that does no harm when it is wrong; `default` where it is missing, empty or, with a warning, wrong."""
        text = section.value(key)
        if not text:
            return default
        try:
            return parse(text, self.remark(section, key))
        except (ValueError, OverflowError):
            self.warn(section, key, f"{text!r} {wrong}")
            return default

    def number(self, section: Section, key: str, default: int = 0) -> int:
        """Integer; `default` where it is missing, empty or not a number."""
        return self.read(section, key, parse_integer, default, f"is not a number; read as {default}")


def decode(data: bytes, faults: EdsFindings) -> str:
    """Text of a file in ASCII, UTF-8, UTF-16 with its mark, or else Latin-1."""
    try:
        text = data.decode("utf-16" if data.startswith(_UTF16_MARKS) else "utf-8-sig")
    except UnicodeDecodeError as error:
        if data.startswith(_UTF16_MARKS):
            faults.fault(0, "", "", f"not a text file: {error.reason}")
            return ""
        line = len(LINE_END_PATTERN.split(data[: error.start].decode("latin-1")))
        faults.warn(line, "", "", f"byte {data[error.start]:02X}h is not UTF-8; the file is read as Latin-1")
        text = data.decode("latin-1")
    if "\0" in text:
        faults.fault(0, "", "", "not a text file: it has zero bytes in it")
        return ""
    return text


def split_sections(text: str, faults: EdsFindings) -> Sections:
    """The sections of a text; what is neither section, key nor comment is left out with a warning."""
    sections: Sections = {}
    repeated: list[tuple[Section, Section]] = []
    current: Section | None = None
    for number, raw in enumerate(LINE_END_PATTERN.split(text), start=1):
        line = raw.strip()
        if not line or line[0] in ";#":
            continue
        if line[0] == "[":
            current = _head(line, number, faults)
            if (first := sections.setdefault(current.name.lower(), current)) is not current:
                repeated.append((first, current))
        elif "=" not in line:
            faults.warn(number, current.name if current else "", "", f"neither section, key nor comment: {line!r}")
        elif current is None:
            faults.warn(number, "", "", f"before the first section, ignored: {line!r}")
        else:
            _add(current, line, number, faults)
    for first, again in repeated:
        _warn_of_repetition(first, again, faults)
    return sections


def _head(line: str, number: int, faults: EdsFindings) -> Section:
    name, bracket, _ = line[1:].partition("]")
    if not bracket:
        name = _COMMENT_PATTERN.sub("", name)
        faults.warn(number, name.strip(), "", "the closing bracket is missing")
    return Section(name.strip(), number)


def _add(section: Section, line: str, number: int, faults: EdsFindings) -> None:
    key, _, value = line.partition("=")
    value = _COMMENT_PATTERN.sub("", f" {value}").strip()
    if len(value) >= 2 and value[0] == value[-1] and value[0] in "\"'":
        value = value[1:-1]
    item = Item(key.strip(), value, number)
    first = section.items.setdefault(item.key.lower(), item)
    if first.value != item.value:
        faults.warn(number, section.name, item.key, f"was {first.value!r} in line {first.line} already, which counts")


def _warn_of_repetition(first: Section, again: Section, faults: EdsFindings) -> None:
    old, new = ({key: item.value for key, item in section.items.items()} for section in (first, again))
    how = "the same" if old == new else "but different"
    faults.warn(again.line, again.name, "", f"is in line {first.line} already, {how}; that one counts")
