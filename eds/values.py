"""Values of an EDS file by data type: DefaultValue, ParameterValue, LowLimit and HighLimit.

Source: CiA 301, "Data types"; CiA 306-1, "Object description".
"""

from __future__ import annotations

import re
import struct

from canopen.objectdictionary import datatypes

from canprobe.fieldbus.eds.numbers import Remark, parse_flag, parse_sum

Value = int | float | bytes | str
SIGNED_BITS = {0x02: 8, 0x03: 16, 0x10: 24, 0x04: 32, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64}
UNSIGNED_BITS = {0x05: 8, 0x06: 16, 0x16: 24, 0x07: 32, 0x18: 40, 0x19: 48, 0x1A: 56, 0x1B: 64}
REAL_FORMS = {datatypes.REAL32: ("<f", 8), datatypes.REAL64: ("<d", 16)}
TEXT_TYPES = {datatypes.VISIBLE_STRING, datatypes.UNICODE_STRING}
OCTET_TYPES = {datatypes.OCTET_STRING, datatypes.DOMAIN}
TIME_TYPES = {datatypes.TIME_OF_DAY, datatypes.TIME_DIFFERENCE}
KNOWN_TYPES = {datatypes.BOOLEAN, *SIGNED_BITS, *UNSIGNED_BITS, *REAL_FORMS, *TEXT_TYPES, *OCTET_TYPES, *TIME_TYPES}
TYPE_NUMBERS = {name: number for name, number in vars(datatypes).items() if name.isupper() and isinstance(number, int)}
_TYPE_NAMES = {number: name for name, number in TYPE_NUMBERS.items()}
FOREIGN_TYPE_NUMBERS = {
    **{f"INT{bits}": number for number, bits in SIGNED_BITS.items()},
    **{f"UINT{bits}": number for number, bits in UNSIGNED_BITS.items()},
    **{f"I{bits}": number for number, bits in SIGNED_BITS.items()},
    **{f"U{bits}": number for number, bits in UNSIGNED_BITS.items()},
    **{"BOOL": 0x01, "SINT": 0x02, "INT": 0x03, "DINT": 0x04, "LINT": 0x15},
    **{"USINT": 0x05, "UINT": 0x06, "UDINT": 0x07, "ULINT": 0x1B, "REAL": 0x08, "LREAL": 0x11},
    **{"FLOAT": 0x08, "DOUBLE": 0x11, "STRING": 0x09},
}
"""Data types by their names in other standards. Source: IEC 61131-3, "Elementary data types"; C's <stdint.h>."""
TIME_BITS = 48
"""Length of TIME_OF_DAY and TIME_DIFFERENCE."""


def name_of(data_type: int) -> str:
    """The standard's name of a data type."""
    return _TYPE_NAMES.get(data_type, f"{data_type:04X}h")


def convert(text: str, data_type: int, node_id: int, remark: Remark) -> Value:
    """Convert a value from the text in the file to that in the dictionary.

    Args:
        text: text of the value; only that of a text may be empty.
        data_type: data type, one of `KNOWN_TYPES`.
        node_id: node id, which replaces $NODEID.
        remark: function that is called with a remark on an odd spelling.

    Raises:
        ValueError, OverflowError: the text means no value of that type.
    """
    if data_type in TEXT_TYPES:
        return text
    if data_type in OCTET_TYPES:
        return _octets(text, remark)
    if data_type in REAL_FORMS:
        return _real(text, data_type, remark)
    if data_type == datatypes.BOOLEAN:
        return int(parse_flag(text, remark))
    number, _ = parse_sum(text, node_id, remark)
    if data_type in TIME_TYPES:
        return number.to_bytes(TIME_BITS // 8, "little")
    return _fitted(number, text, data_type, remark)


def convert_limit(text: str, data_type: int, node_id: int, remark: Remark) -> int | float | None:
    """Convert a limit; None for a type without limits.

    Raises:
        ValueError, OverflowError: the text means no number of that type.
    """
    if data_type not in SIGNED_BITS | UNSIGNED_BITS | REAL_FORMS:
        return None
    value = convert(text, data_type, node_id, remark)
    assert not isinstance(value, (bytes, str))
    return value


def _fitted(number: int, text: str, data_type: int, remark: Remark) -> int:
    """Number in the range of its type; 0xFFFF for -1 is usual, -1 for 0xFFFF is odd."""
    signed = data_type in SIGNED_BITS
    bits = SIGNED_BITS[data_type] if signed else UNSIGNED_BITS[data_type]
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    if low <= number <= high:
        return number
    wrapped = number - (1 << bits) if signed else number + (1 << bits)
    if not (low <= wrapped <= high and -(1 << bits - 1) <= number < 1 << bits):
        raise ValueError(f"{text} does not fit {name_of(data_type)}")
    if not (signed and "0x" in text.lower()):
        remark(f"{text} does not fit {name_of(data_type)}; read as {wrapped}")
    return wrapped


def _octets(text: str, remark: Remark) -> bytes:
    try:
        return bytes.fromhex(re.sub(r"(?i)\b0x", "", text))
    except ValueError:
        remark(f"{text!r} is not a row of hexadecimal bytes; its characters are taken")
        return text.encode("latin-1", "replace")


def _real(text: str, data_type: int, remark: Remark) -> float:
    form, digits = REAL_FORMS[data_type]
    if re.fullmatch(rf"0[xX][0-9A-Fa-f]{{{digits}}}", text):
        real: float = struct.unpack(form, bytes.fromhex(text[2:])[::-1])[0]
        remark(f"{text} is taken for the bytes of {real:g}")
        return real
    number = _decimal(text, remark)
    struct.pack(form, number)  # OverflowError where it does not fit
    return number


def _decimal(text: str, remark: Remark) -> float:
    if re.fullmatch(r"[+-]?\d*,\d+", text):
        remark(f"{text} has a comma for its decimal point")
        return float(text.replace(",", "."))
    try:
        return float(text)
    except ValueError:
        return float(parse_sum(text, 0, remark)[0])
