"""Facts that the standards fix about the objects that every node needs.

Source: CiA 301, "Communication profile area"; CiA 402-2, object descriptions.
"""

from __future__ import annotations

from canprobe.fieldbus.protocol.pdo import PDO_OBJECTS, is_mapping

U8, _U16, _U32, _I8, _I16, _I32 = 0x05, 0x06, 0x07, 0x02, 0x03, 0x04
_VARIABLE_TYPES = {
    **dict.fromkeys((0x1000, 0x1002, 0x1005, 0x1006, 0x1007, 0x1012, 0x1013, 0x1014, 0x6502), _U32),
    **dict.fromkeys((0x100C, 0x1015, 0x1017, 0x603F, 0x6040, 0x6041), _U16),
    **dict.fromkeys((0x1001, 0x100D, 0x1019), U8),
    **dict.fromkeys((0x6060, 0x6061), _I8),
    **dict.fromkeys((0x6071, 0x6077), _I16),
    **dict.fromkeys((0x6062, 0x6064, 0x606C, 0x607A, 0x60F4, 0x60FF), _I32),
}
_ARRAY_TYPES = dict.fromkeys((0x1003, 0x1010, 0x1011, 0x1016, 0x1018), _U32)
_READ_ONLY_INDICES = frozenset(
    {
        *(0x1000, 0x1001, 0x1002, 0x1008, 0x1009, 0x100A, 0x1018),
        *(0x603F, 0x6041, 0x6061, 0x6062, 0x6063, 0x6064, 0x606B, 0x606C, 0x6074, 0x6077, 0x60F4, 0x6502),
    }
)
USUAL_TYPES = {
    **{(index, 0): _I16 for index in (0x6007, *range(0x605A, 0x605F), 0x60C0)},
    **{(index, 0): _U32 for index in (0x6065, 0x607F, 0x6080, 0x6083, 0x6084, 0x6085, 0x609A)},
    **{(0x6066, 0): _U16, (0x607C, 0): _I32, (0x607E, 0): U8, (0x6098, 0): _I8},
    **{(0x607D, 1): _I32, (0x607D, 2): _I32, (0x6099, 1): _U32, (0x6099, 2): _U32},
    **{(0x60C1, 1): _I32, (0x60C2, 1): U8, (0x60C2, 2): _I8},
}
"""Types of a drive's objects that makers may change, by index and sub-index; taken where a file states none."""
_COMMUNICATION_TYPES = {1: _U32, 2: U8, 3: _U16, 5: _U16, 6: U8}
CHOICE_INDICES = frozenset({0x6007, *range(0x605A, 0x605F), 0x6086, 0x6098, 0x60C0})
"""Objects of a drive whose value 0 is a choice, maybe the only one, such as a linear ramp."""
COUNTING_INDICES = frozenset({0x1003, *filter(is_mapping, PDO_OBJECTS)})
"""Objects whose sub-index 0 is the number of entries in use, and can be written."""
_FIRST_PROFILE_INDEX = 0x6000
"""First index of the profile area, where CiA 402 describes drives; other profiles are not known here."""


def is_variable(index: int, drive: bool) -> bool:
    """Whether a standard has a plain variable at this index of a device, which may be a drive."""
    return index in _VARIABLE_TYPES and (drive or index < _FIRST_PROFILE_INDEX)


def decides(index: int) -> bool:
    """Whether values of an object decide what the device is and which PDOs it has: the profile, the identity, PDOs."""
    return index in (0x1000, 0x1018) or index in PDO_OBJECTS


def standard_type(index: int, subindex: int, drive: bool) -> int | None:
    """The data type that a standard fixes for a device, which may be a drive; None where a maker may choose."""
    if index >= _FIRST_PROFILE_INDEX and not drive:
        return None
    if subindex == 0:
        fixed = index in _ARRAY_TYPES or index in PDO_OBJECTS or 0x1200 <= index < 0x1300
        return U8 if fixed else _VARIABLE_TYPES.get(index)
    if index in PDO_OBJECTS:
        return _U32 if is_mapping(index) else _COMMUNICATION_TYPES.get(subindex)
    return _U32 if 0x1200 <= index < 0x1300 and subindex < 3 else _ARRAY_TYPES.get(index)


def standard_access(index: int, subindex: int, composite: bool, drive: bool) -> str:
    """AccessType where the file states none: that of the standard, else free access."""
    read_only = index in _READ_ONLY_INDICES and (drive or index < _FIRST_PROFILE_INDEX)
    if read_only or (composite and subindex == 0 and index not in COUNTING_INDICES):
        return "ro"
    return "rw"
