"""Bytes of an EDS file → its sections, keys and numbers, each with its line, and what is wrong with them.

Read as Windows reads an INI file, which is what vendors' tools do: names in any case, the first of two counts.
Source: CiA 306-1, "General structure".
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable
from dataclasses import dataclass, field

# What is wrong in an EDS file, and where.


@dataclass(frozen=True, slots=True)
class Fault:
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
class Faults:
    """Collects faults while a file is read."""

    found: list[Fault] = field(default_factory=list)

    def fault(self, line: int, section: str, key: str, text: str) -> None:
        """What the device would answer cannot be known."""
        self.found.append(Fault(line, section, key, text, True))

    def warn(self, line: int, section: str, key: str, text: str) -> None:
        """Not as it should be, but the meaning is clear or the rest can be served."""
        self.found.append(Fault(line, section, key, text, False))

    def sorted(self) -> tuple[Fault, ...]:
        """By line."""
        return tuple(sorted(self.found, key=lambda fault: fault.line))


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


# Numbers as EDS files write them: decimal, 0x1A, octal with a leading 0, and sums with $NODEID.
#
# Source: CiA 306-1, "General structure" (number formats) and "Object description" ($NODEID).

Remark = Callable[[str], None]

_HEX = re.compile(r"([+-]?)0x([0-9a-f]+)", re.IGNORECASE)
_HEX_SUFFIX = re.compile(r"()([0-9][0-9a-f]*)h", re.IGNORECASE)
_DECIMAL = re.compile(r"[+-]?[0-9]+")
_WHOLE_REAL = re.compile(r"([+-]?[0-9]+)[.,]0*")
_C_SUFFIX = re.compile(r"(.*[0-9a-f])(?:u|l|ul|lu|ll|ull|llu)", re.IGNORECASE)
_GROUPED = re.compile(r"[+-]?(?:0x[0-9a-f]+(?:[ _]+[0-9a-f]+)+|[0-9]+(?:_+[0-9]+)+)", re.IGNORECASE)
_NODE_ID = re.compile(r"\$node_?id", re.IGNORECASE)
_ODD_NODE_ID = re.compile(r"\$?\(?\$?\{?\s*node[ _-]?id\s*\}?\)?", re.IGNORECASE)


def parse_integer(text: str, remark: Remark) -> int:
    """One number.

    Args:
        text: without blanks round it.
        remark: called with what is odd about it.

    Raises:
        ValueError: it is not a number.
    """
    if match := _HEX.fullmatch(text):
        return int(match[1] + match[2], 16)
    if match := _HEX_SUFFIX.fullmatch(text):
        remark(f"{text} is read as {int(match[2], 16):#x}; hexadecimal numbers begin with 0x")
        return int(match[2], 16)
    if not _DECIMAL.fullmatch(text):
        return _written_as_elsewhere(text, remark)
    return _leading_zeros(text, remark)


def _written_as_elsewhere(text: str, remark: Remark) -> int:
    """A whole number as programming languages write it: 0.0, 100UL, 0x0001_0000, 0x00 01."""
    if (match := _C_SUFFIX.fullmatch(text)) or (match := _WHOLE_REAL.fullmatch(text)):
        plain = match[1]
    elif _GROUPED.fullmatch(text):
        plain = text.replace(" ", "").replace("_", "")
    else:
        raise ValueError(f"{text!r} is not a number")
    number = parse_integer(plain, remark)
    remark(f"{text} is read as {plain}")
    return number


def _leading_zeros(text: str, remark: Remark) -> int:
    digits = text.lstrip("+-")
    if len(digits) == 1 or digits[0] != "0":
        return int(text)
    if set(digits) <= set("01234567"):
        octal = int(text, 8)
        if octal != int(text):
            remark(f"{text} is octal by CiA 306, {octal}; {int(text)} is written without the leading zero")
        return octal
    remark(f"{text} begins with a zero, as octal numbers do, but is not octal; read as {int(text)}")
    return int(text)


def parse_sum(text: str, node_id: int, remark: Remark) -> tuple[int, bool]:
    """A number or a sum of numbers and $NODEID, in any order and case.

    Returns:
        The value for this node, and whether it depends on the node.

    Raises:
        ValueError: it is not a number.
    """
    total, relative = 0, False
    for term in map(str.strip, _terms(text, remark)):
        if _NODE_ID.fullmatch(term):
            total, relative = total + node_id, True
        elif _ODD_NODE_ID.fullmatch(term):
            remark(f"{term} is read as $NODEID")
            total, relative = total + node_id, True
        elif term:
            total += parse_integer(term, remark)
        else:
            raise ValueError(f"{text!r} is not a number")
    return total, relative


def _terms(text: str, remark: Remark) -> list[str]:
    """What is added up: without brackets round all of it, or a plus before a number."""
    whole = text.strip()
    if whole[:1] == "(" and whole[-1:] == ")" and "+" in whole:
        remark(f"{text} is read without its brackets")
        whole = whole[1:-1].strip()
    if whole[:1] == "+" and whole[1:2].isdigit():
        whole = whole[1:]
    return whole.split("+")


_WORDS = {"true": True, "yes": True, "false": False, "no": False}


def parse_flag(text: str, remark: Remark) -> bool:
    """0 or 1; a word for it is remarked upon.

    Raises:
        ValueError: it is neither.
    """
    word = _WORDS.get(text.lower())
    if word is None:
        return parse_integer(text, remark) != 0
    remark(f"{text} is read as {int(word)}")
    return word


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
