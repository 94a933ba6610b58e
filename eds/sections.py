"""Bytes of an EDS file → its sections, keys and numbers, each with its line, and what is wrong with them.

Read as Windows reads an INI file, which is what vendors' tools do: names in any case, the first of two counts.
Source: CiA 306-1, "General structure".
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable
from dataclasses import dataclass, field

from canprobe.fieldbus.eds.findings import Faults
from canprobe.fieldbus.eds.numbers import parse_integer

# The text of a file → its sections.

LINE_END = re.compile(r"\r\n|\n|\r")
_INLINE_COMMENT = re.compile(r"\s;.*")
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


@dataclass(frozen=True, slots=True)
class Item:
    """One `key=value`; the value without blanks, quotes round it and a comment behind it."""

    key: str
    value: str
    line: int


@dataclass(slots=True)
class Section:
    """One section.

    Attributes:
        name: as written, without the brackets.
        line: of its head.
        items: by key in lower case.
    """

    name: str
    line: int
    items: dict[str, Item] = field(default_factory=dict)

    def value(self, key: str) -> str:
        """The value; empty where the key is missing."""
        item = self.items.get(key.lower())
        return "" if item is None else item.value

    def line_of(self, key: str) -> int:
        """Where the key is, or the section where it is missing."""
        item = self.items.get(key.lower())
        return self.line if item is None else item.line


Sections = dict[str, Section]
"""By name in lower case, in the order of the file."""


def decode(data: bytes, faults: Faults) -> str:
    """Text of a file in ASCII, UTF-8, UTF-16 with its mark, or else Latin-1."""
    try:
        text = data.decode("utf-16" if data.startswith(_UTF16) else "utf-8-sig")
    except UnicodeDecodeError as error:
        if data.startswith(_UTF16):
            faults.fault(0, "", "", f"not a text file: {error.reason}")
            return ""
        line = len(LINE_END.split(data[: error.start].decode("latin-1")))
        faults.warn(line, "", "", f"byte {data[error.start]:02X}h is not UTF-8; the file is read as Latin-1")
        text = data.decode("latin-1")
    if "\0" in text:
        faults.fault(0, "", "", "not a text file: it has zero bytes in it")
        return ""
    return text


def split_sections(text: str, faults: Faults) -> Sections:
    """The sections of a text; what is neither section, key nor comment is left out with a warning."""
    sections: Sections = {}
    repeated: list[tuple[Section, Section]] = []
    current: Section | None = None
    for number, raw in enumerate(LINE_END.split(text), start=1):
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


def _head(line: str, number: int, faults: Faults) -> Section:
    name, bracket, _ = line[1:].partition("]")
    if not bracket:
        name = _INLINE_COMMENT.sub("", name)
        faults.warn(number, name.strip(), "", "the closing bracket is missing")
    return Section(name.strip(), number)


def _add(section: Section, line: str, number: int, faults: Faults) -> None:
    key, _, value = line.partition("=")
    value = _INLINE_COMMENT.sub("", f" {value}").strip()
    if len(value) >= 2 and value[0] == value[-1] and value[0] in "\"'":
        value = value[1:-1]
    item = Item(key.strip(), value, number)
    first = section.items.setdefault(item.key.lower(), item)
    if first.value != item.value:
        faults.warn(number, section.name, item.key, f"was {first.value!r} in line {first.line} already, which counts")


def _warn_of_repetition(first: Section, again: Section, faults: Faults) -> None:
    old, new = ({key: item.value for key, item in section.items.items()} for section in (first, again))
    how = "the same" if old == new else "but different"
    faults.warn(again.line, again.name, "", f"is in line {first.line} already, {how}; that one counts")


# What the builders of a dictionary share.


@dataclass(frozen=True, slots=True)
class Source:
    """An EDS file in pieces.

    Attributes:
        sections: of the file.
        node_id: for $NODEID.
        faults: collects what is wrong.
        drive: the device is a drive of CiA 402.
    """

    sections: Sections
    node_id: int
    faults: Faults
    drive: bool = False

    def warn(self, section: Section, key: str, text: str) -> None:
        """A warning at a key, or at its section where the key is missing."""
        self.faults.warn(section.line_of(key), section.name, key, text)

    def fault(self, section: Section, key: str, text: str) -> None:
        """A fault at a key, or at its section where the key is missing."""
        self.faults.fault(section.line_of(key), section.name, key, text)

    def remark(self, section: Section, key: str) -> Callable[[str], None]:
        """What a parser calls with what is odd about a value."""
        return lambda text: self.warn(section, key, text)

    def number(self, section: Section, key: str, default: int = 0) -> int:
        """An integer that does no harm when it is wrong; `default` where it is missing, empty or none."""
        text = section.value(key)
        if not text:
            return default
        try:
            return parse_integer(text, self.remark(section, key))
        except ValueError as error:
            self.warn(section, key, f"{error}; read as {default}")
            return default
