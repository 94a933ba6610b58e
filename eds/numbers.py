"""Numbers as EDS files write them: decimal, 0x1A, octal with a leading 0, and sums with $NODEID.

Source: CiA 306-1, "General structure" (number formats) and "Object description" ($NODEID).
"""

from __future__ import annotations

import re
from collections.abc import Callable

Remark = Callable[[str], None]
_HEX_PATTERN = re.compile(r"([+-]?)0x([0-9a-f]+)", re.IGNORECASE)
_HEX_SUFFIX_PATTERN = re.compile(r"()([0-9][0-9a-f]*)h", re.IGNORECASE)
_DECIMAL_PATTERN = re.compile(r"[+-]?[0-9]+")
_WHOLE_REAL_PATTERN = re.compile(r"([+-]?[0-9]+)[.,]0*")
_C_SUFFIX_PATTERN = re.compile(r"(.*[0-9a-f])(?:u|l|ul|lu|ll|ull|llu)", re.IGNORECASE)
_GROUPED_PATTERN = re.compile(r"[+-]?(?:0x[0-9a-f]+(?:[ _]+[0-9a-f]+)+|[0-9]+(?:_+[0-9]+)+)", re.IGNORECASE)
_NODE_ID_PATTERN = re.compile(r"\$node_?id", re.IGNORECASE)
_ODD_NODE_ID_PATTERN = re.compile(r"\$?\(?\$?\{?\s*node[ _-]?id\s*\}?\)?", re.IGNORECASE)


def parse_integer(text: str, remark: Remark) -> int:
    """Read one number.

    Args:
        text: text of the number, without blanks around it.
        remark: function that is called with a remark on an odd spelling.

    Raises:
        ValueError: the text is not a number.
    """
    if match := _HEX_PATTERN.fullmatch(text):
        return int(match[1] + match[2], 16)
    if match := _HEX_SUFFIX_PATTERN.fullmatch(text):
        remark(f"{text} is read as {int(match[2], 16):#x}; hexadecimal numbers begin with 0x")
        return int(match[2], 16)
    if not _DECIMAL_PATTERN.fullmatch(text):
        return _written_as_elsewhere(text, remark)
    return _leading_zeros(text, remark)


def _written_as_elsewhere(text: str, remark: Remark) -> int:
    """Read a whole number as programming languages write it: 0.0, 100UL, 0x0001_0000, 0x00 01."""
    if (match := _C_SUFFIX_PATTERN.fullmatch(text)) or (match := _WHOLE_REAL_PATTERN.fullmatch(text)):
        plain = match[1]
    elif _GROUPED_PATTERN.fullmatch(text):
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
    """Read a number, or a sum of numbers and $NODEID in any order and case.

    Returns:
        The value for this node, and whether it depends on the node.

    Raises:
        ValueError: the text is not a number.
    """
    total, relative = 0, False
    for term in map(str.strip, _terms(text, remark)):
        if _NODE_ID_PATTERN.fullmatch(term):
            total, relative = total + node_id, True
        elif _ODD_NODE_ID_PATTERN.fullmatch(term):
            remark(f"{term} is read as $NODEID")
            total, relative = total + node_id, True
        elif term:
            total += parse_integer(term, remark)
        else:
            raise ValueError(f"{text!r} is not a number")
    return total, relative


def _terms(text: str, remark: Remark) -> list[str]:
    """Terms of a sum, without brackets around all of it or a plus before a number."""
    whole = text.strip()
    if whole[:1] == "(" and whole[-1:] == ")" and "+" in whole:
        remark(f"{text} is read without its brackets")
        whole = whole[1:-1].strip()
    if whole[:1] == "+" and whole[1:2].isdigit():
        whole = whole[1:]
    return whole.split("+")


_FLAG_WORDS = {"true": True, "yes": True, "false": False, "no": False}


def parse_flag(text: str, remark: Remark) -> bool:
    """Read 0 or 1; a word for it causes a remark.

    Raises:
        ValueError: the text is neither.
    """
    word = _FLAG_WORDS.get(text.lower())
    if word is None:
        return parse_integer(text, remark) != 0
    remark(f"{text} is read as {int(word)}")
    return word
