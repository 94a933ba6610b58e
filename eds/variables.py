"""One section of an EDS file → one variable of the dictionary: its data type, its values, its limits.

Source: CiA 306-1, "Object description".
"""

from __future__ import annotations

import re
import struct
from contextlib import suppress

from canopen.objectdictionary import ODVariable, datatypes

from canprobe.fieldbus.eds.sections import Remark, Section, Source, parse_flag, parse_integer, parse_sum

# What the standards themselves fix about objects that a node cannot do without.
#
# Source: CiA 301, "Communication profile area"; CiA 402-2, object descriptions.

_U8, _U16, _U32, _I8, _I16, _I32 = 0x05, 0x06, 0x07, 0x02, 0x03, 0x04

_VARIABLES = {
    **dict.fromkeys((0x1000, 0x1002, 0x1005, 0x1006, 0x1007, 0x1012, 0x1013, 0x1014, 0x6502), _U32),
    **dict.fromkeys((0x100C, 0x1015, 0x1017, 0x603F, 0x6040, 0x6041), _U16),
    **dict.fromkeys((0x1001, 0x100D, 0x1019), _U8),
    **dict.fromkeys((0x6060, 0x6061), _I8),
    **dict.fromkeys((0x6071, 0x6077), _I16),
    **dict.fromkeys((0x6062, 0x6064, 0x606C, 0x607A, 0x60F4, 0x60FF), _I32),
}
_ARRAYS = dict.fromkeys((0x1003, 0x1010, 0x1011, 0x1016, 0x1018), _U32)
_READ_ONLY = frozenset(
    {
        *(0x1000, 0x1001, 0x1002, 0x1008, 0x1009, 0x100A, 0x1018),
        *(0x603F, 0x6041, 0x6061, 0x6062, 0x6063, 0x6064, 0x606B, 0x606C, 0x6074, 0x6077, 0x60F4, 0x6502),
    }
)
_MISSING = {
    **{(index, 0): _I16 for index in (0x6007, *range(0x605A, 0x605F), 0x60C0)},
    **{(index, 0): _U32 for index in (0x6065, 0x607F, 0x6080, 0x6083, 0x6084, 0x6085, 0x609A)},
    **{(0x6066, 0): _U16, (0x607C, 0): _I32, (0x607E, 0): _U8, (0x6098, 0): _I8},
    **{(0x607D, 1): _I32, (0x607D, 2): _I32, (0x6099, 1): _U32, (0x6099, 2): _U32},
    **{(0x60C1, 1): _I32, (0x60C2, 1): _U8, (0x60C2, 2): _I8},
}
"""Types of a drive's objects that makers change, by index and sub-index: taken where a file states none."""
_COMMUNICATION = {1: _U32, 2: _U8, 3: _U16, 5: _U16, 6: _U8}
_CHOICES = frozenset({0x6007, *range(0x605A, 0x605F), 0x6086, 0x6098, 0x60C0})
"""Objects of a drive whose 0 is a choice and may be the only one, such as a linear ramp."""
COUNTING = frozenset({0x1003, *range(0x1600, 0x1800), *range(0x1A00, 0x1C00)})
"""Where sub-index 0 says how many entries are in use, and can be written."""
_PROFILE_AREA = 0x6000
"""From here on CiA 402 describes drives alone; what other profiles have there is not known here."""


def is_variable(index: int, drive: bool) -> bool:
    """Whether a standard has a plain variable at this index of a device, which may be a drive."""
    return index in _VARIABLES and (drive or index < _PROFILE_AREA)


def decides(index: int) -> bool:
    """Whether values of an object decide what the device is and which PDOs it has: the profile, the identity, PDOs."""
    return index in (0x1000, 0x1018) or 0x1400 <= index < 0x1C00


def standard_type(index: int, subindex: int, drive: bool) -> int | None:
    """The data type that a standard fixes for a device, which may be a drive; None where a maker may choose."""
    if index >= _PROFILE_AREA and not drive:
        return None
    if subindex == 0:
        fixed = index in _ARRAYS or 0x1400 <= index < 0x1C00 or 0x1200 <= index < 0x1300
        return _U8 if fixed else _VARIABLES.get(index)
    if 0x1400 <= index < 0x1600 or 0x1800 <= index < 0x1A00:
        return _COMMUNICATION.get(subindex)
    if 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00:
        return _U32
    return _U32 if 0x1200 <= index < 0x1300 and subindex < 3 else _ARRAYS.get(index)


def standard_access(index: int, subindex: int, composite: bool, drive: bool) -> str:
    """What AccessType is where the file does not say: the standard's, else free access."""
    read_only = index in _READ_ONLY and (drive or index < _PROFILE_AREA)
    if read_only or (composite and subindex == 0 and index not in COUNTING):
        return "ro"
    return "rw"


# Values of an EDS file by data type: DefaultValue, ParameterValue, LowLimit and HighLimit.
#
# Source: CiA 301, "Data types"; CiA 306-1, "Object description".

Value = int | float | bytes | str

SIGNED = {0x02: 8, 0x03: 16, 0x10: 24, 0x04: 32, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64}
UNSIGNED = {0x05: 8, 0x06: 16, 0x16: 24, 0x07: 32, 0x18: 40, 0x19: 48, 0x1A: 56, 0x1B: 64}
REALS = {datatypes.REAL32: ("<f", 8), datatypes.REAL64: ("<d", 16)}
TEXTS = {datatypes.VISIBLE_STRING, datatypes.UNICODE_STRING}
OCTETS = {datatypes.OCTET_STRING, datatypes.DOMAIN}
TIMES = {datatypes.TIME_OF_DAY, datatypes.TIME_DIFFERENCE}
KNOWN = {datatypes.BOOLEAN, *SIGNED, *UNSIGNED, *REALS, *TEXTS, *OCTETS, *TIMES}
NAMES = {name: number for name, number in vars(datatypes).items() if name.isupper() and isinstance(number, int)}
_NAME_OF = {number: name for name, number in NAMES.items()}
_WORDS_OF_TYPES = {
    **{f"INT{bits}": number for number, bits in SIGNED.items()},
    **{f"UINT{bits}": number for number, bits in UNSIGNED.items()},
    **{f"I{bits}": number for number, bits in SIGNED.items()},
    **{f"U{bits}": number for number, bits in UNSIGNED.items()},
    **{"BOOL": 0x01, "SINT": 0x02, "INT": 0x03, "DINT": 0x04, "LINT": 0x15},
    **{"USINT": 0x05, "UINT": 0x06, "UDINT": 0x07, "ULINT": 0x1B, "REAL": 0x08, "LREAL": 0x11},
    **{"FLOAT": 0x08, "DOUBLE": 0x11, "STRING": 0x09},
}
"""Names of data types elsewhere. Source: IEC 61131-3, "Elementary data types"; C's <stdint.h>."""
_TIME_BYTES = 6


def name_of(data_type: int) -> str:
    """The standard's name of a data type."""
    return _NAME_OF.get(data_type, f"{data_type:04X}h")


def convert(text: str, data_type: int, node_id: int, remark: Remark) -> Value:
    """A value as the file writes it → as the dictionary holds it.

    Args:
        text: not empty, except for texts.
        data_type: one of `KNOWN`.
        node_id: for $NODEID.
        remark: called with what is odd about it.

    Raises:
        ValueError, OverflowError: it does not mean a value of that type.
    """
    if data_type in TEXTS:
        return text
    if data_type in OCTETS:
        return _octets(text, remark)
    if data_type in REALS:
        return _real(text, data_type, remark)
    if data_type == datatypes.BOOLEAN:
        return int(parse_flag(text, remark))
    number, _ = parse_sum(text, node_id, remark)
    if data_type in TIMES:
        return number.to_bytes(_TIME_BYTES, "little")
    return _fitted(number, text, data_type, remark)


def convert_limit(text: str, data_type: int, node_id: int, remark: Remark) -> int | float | None:
    """A limit; None where a type has none.

    Raises:
        ValueError, OverflowError: it does not mean a number of that type.
    """
    if data_type not in SIGNED | UNSIGNED | REALS:
        return None
    value = convert(text, data_type, node_id, remark)
    assert not isinstance(value, (bytes, str))
    return value


def _fitted(number: int, text: str, data_type: int, remark: Remark) -> int:
    """The number in its type's range; 0xFFFF for -1 is usual, -1 for 0xFFFF is odd."""
    signed = data_type in SIGNED
    bits = SIGNED[data_type] if signed else UNSIGNED[data_type]
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
    form, digits = REALS[data_type]
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


# The data type of a variable: as the file says, as its editor defined it, or as the standard demands.
#
# Source: CiA 306-1, "Object description"; CiA 301, "Data types".

_OBJECT_DOMAIN = 2


def data_type_of(source: Source, section: Section, index: int, subindex: int, composite: bool) -> int | None:
    """The data type that a section means, one of `KNOWN`; None where it cannot be known."""
    text = section.value("DataType")
    demanded = standard_type(index, subindex, source.drive)
    usual = _U8 if composite and subindex == 0 else _MISSING.get((index, subindex)) if source.drive else None
    if not text:
        return _untyped(source, section, demanded or usual, "missing")
    if (named := _named_type(text)) is not None:
        source.warn(section, "DataType", f"{text} is read as {named:#06x}")
        data_type = named
    else:
        try:
            data_type = parse_integer(text, source.remark(section, "DataType"))
        except ValueError:
            return _untyped(source, section, demanded or usual, f"{text!r} is not a data type")
    if data_type not in KNOWN:
        data_type = _foreign(source, section, data_type)
    if demanded is not None and data_type != demanded:
        source.warn(section, "DataType", f"{name_of(data_type)}, but the standard demands {name_of(demanded)}; taken")
        return demanded
    return data_type


def _named_type(text: str) -> int | None:
    word = re.sub(r"[\s_]", "", text.upper())
    named = NAMES.get(text.upper(), _WORDS_OF_TYPES.get(word.removesuffix("T") if word[-2:-1].isdigit() else word))
    return named if named in KNOWN else None


def _untyped(source: Source, section: Section, demanded: int | None, why: str) -> int | None:
    if demanded is not None:
        source.warn(section, "DataType", f"{why}; the standard demands {name_of(demanded)}; taken")
    elif section.value("ObjectType") and source.number(section, "ObjectType") == _OBJECT_DOMAIN:
        return int(datatypes.DOMAIN)
    else:
        source.warn(section, "DataType", f"{why}, so the length of the object is not known; served as octets")
    return demanded


def _foreign(source: Source, section: Section, data_type: int) -> int:
    """A type of the maker's own: defined in a section such as [A0] by some editors, else served as octets."""
    definition = source.sections.get(f"{data_type:x}sub1")
    base = source.number(definition, "DefaultValue") if definition is not None else 0
    if base in KNOWN:
        return base
    source.warn(section, "DataType", f"{data_type:#06x} is not a type of CiA 301; the object is served as octets")
    return int(datatypes.DOMAIN)


# One section → one variable.

_ACCESS = frozenset({"ro", "wo", "rw", "rwr", "rww", "const"})
_ACCESS_WORDS = {"r": "ro", "w": "wo", "wr": "rw", "readonly": "ro", "writeonly": "wo", "readwrite": "rw", "c": "const"}


def build_variable(source: Source, section: Section, index: int, subindex: int, composite: bool = False) -> ODVariable:
    """The variable that a section describes; one whose data type cannot be known holds octets and has no value.

    Args:
        source: the file.
        section: the variable's, or with CompactSubObj that of the whole object.
        index, subindex: of the variable.
        composite: it is part of an array or record.
    """
    known = data_type_of(source, section, index, subindex, composite)
    data_type = int(datatypes.DOMAIN) if known is None else known
    variable = ODVariable(_name(source, section, index, subindex), index, subindex)
    variable.data_type = data_type
    variable.access_type = _access(source, section, index, subindex, composite)
    variable.pdo_mappable = _flag(source, section, "PDOMapping")
    _set_limits(source, section, variable, data_type)
    if known is not None:
        set_value(source, section, "DefaultValue", variable)
        set_value(source, section, "ParameterValue", variable)
    default, low, high = variable.default, variable.min, variable.max
    if isinstance(default, int | float) and (
        (low is not None and default < low) or (high is not None and default > high)
    ):
        source.warn(section, "DefaultValue", f"{default} is outside LowLimit and HighLimit; served")
    return variable


def set_value(source: Source, section: Section, key: str, variable: ODVariable, name: str = "") -> None:
    """Give the variable its `DefaultValue` or `ParameterValue`; `name` is the key where it is another one."""
    where, data_type = name or key, variable.data_type or datatypes.DOMAIN
    if where.lower() not in section.items:
        return
    text = section.value(where)
    field = "default" if key == "DefaultValue" else "value"
    setattr(variable, f"{field}_raw", text)
    if not text and data_type not in TEXTS:
        return
    try:
        setattr(variable, field, convert(text, data_type, source.node_id, source.remark(section, where)))
    except (ValueError, OverflowError):
        wrong = f"{text!r} is not a value of type {name_of(data_type)}"
        if decides(variable.index):
            source.fault(section, where, wrong)
        else:
            source.warn(section, where, f"{wrong}; left out, as if the file had none")
        return
    if field == "default" and "$" in text and data_type not in TEXTS:
        with suppress(ValueError):
            variable.relative = parse_sum(text, source.node_id, lambda _: None)[1]


def _name(source: Source, section: Section, index: int, subindex: int) -> str:
    name = section.value("ParameterName")
    if not name:
        name = f"Object {index:04X}h:{subindex:02X}"
        source.warn(section, "ParameterName", f"missing; named {name!r}")
    return name


def _access(source: Source, section: Section, index: int, subindex: int, composite: bool) -> str:
    text = section.value("AccessType").lower()
    if text in _ACCESS:
        return text
    taken = _ACCESS_WORDS.get("".join(filter(str.isalpha, text))) or standard_access(
        index, subindex, composite, source.drive
    )
    what = f"{section.value('AccessType')!r} is none of CiA 306" if text else "missing"
    source.warn(section, "AccessType", f"{what}; taken for {taken}")
    return taken


def _flag(source: Source, section: Section, key: str) -> bool:
    text = section.value(key)
    if not text:
        return False  # the default of CiA 306
    try:
        return parse_flag(text, source.remark(section, key))
    except ValueError:
        source.warn(section, key, f"{text!r} is neither 0 nor 1; read as 0")
        return False


def _set_limits(source: Source, section: Section, variable: ODVariable, data_type: int) -> None:
    low = _limit(source, section, "LowLimit", data_type)
    high = _limit(source, section, "HighLimit", data_type)
    if low == high == 0 and not (source.drive and variable.index in _CHOICES):
        source.warn(
            section, "LowLimit", "0, and HighLimit 0 too, as editors fill in what nobody stated; neither is used"
        )
        return
    if low is not None and high is not None and low > high:
        source.warn(section, "LowLimit", f"{low} is above HighLimit {high}; neither is used")
        return
    variable.min, variable.max = low, high  # type: ignore[assignment]  # of a REAL they are floats


def _limit(source: Source, section: Section, key: str, data_type: int) -> int | float | None:
    text = section.value(key)
    if not text:
        return None
    try:
        return convert_limit(text, data_type, source.node_id, source.remark(section, key))
    except (ValueError, OverflowError):
        source.warn(section, key, f"{text!r} is not a value of type {name_of(data_type)}; not used")
        return None
