"""One entry of the object dictionary: its type, its rights, its limits, and the bytes of a value.

Source: CiA 301, "Data type entry usage" and "Object dictionary", EDS keywords of CiA 306.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from canopen.objectdictionary import ObjectDictionary, ODVariable, datatypes

from canprobe.emulator.aborts import Abort, SdoAbort

Value = int | float | bytes

_UNSIGNED = {0x01: 8, 0x05: 8, 0x06: 16, 0x07: 32, 0x16: 24, 0x18: 40, 0x19: 48, 0x1A: 56, 0x1B: 64}
_SIGNED = {0x02: 8, 0x03: 16, 0x04: 32, 0x10: 24, 0x12: 40, 0x13: 48, 0x14: 56, 0x15: 64}
_FLOAT = {datatypes.REAL32: "<f", datatypes.REAL64: "<d"}


def key_of(index: int, subindex: int = 0) -> int:
    """Index and subindex as one dictionary key."""
    return index << 8 | subindex


@dataclass(frozen=True, slots=True)
class Entry:
    """One addressable value.

    Attributes:
        key: index << 8 | subindex.
        bits: length of a fixed-size value; 0 for strings and domains.
        signed: whether an integer is signed.
        real: struct format of a REAL32/REAL64, or empty.
        readable, writable: access over SDO.
        in_tpdo, in_rpdo: may be mapped there.
        low, high: limits of the EDS, or None.
        default: value after a reset.
    """

    key: int
    name: str
    bits: int
    signed: bool
    real: str
    readable: bool
    writable: bool
    in_tpdo: bool
    in_rpdo: bool
    low: float | None
    high: float | None
    default: Value

    def to_bytes(self, value: Value) -> bytes:
        """Value → bytes on the wire."""
        if isinstance(value, bytes):
            return value
        if self.real:
            return struct.pack(self.real, value)
        return int(value).to_bytes(self.bits // 8, "little", signed=self.signed)

    def from_bytes(self, data: bytes) -> Value:
        """Bytes on the wire → value. Raises SdoAbort when the length is not the object's."""
        if not self.bits:
            return bytes(data)
        if len(data) * 8 != self.bits:
            raise SdoAbort(Abort.TOO_LONG if len(data) * 8 > self.bits else Abort.TOO_SHORT)
        if self.real:
            number: float = struct.unpack(self.real, data)[0]
            return number
        return int.from_bytes(data, "little", signed=self.signed)

    def check_limits(self, value: Value) -> None:
        """Raises SdoAbort when the value is outside the EDS's limits."""
        if isinstance(value, bytes):
            return
        if self.high is not None and value > self.high:
            raise SdoAbort(Abort.VALUE_HIGH)
        if self.low is not None and value < self.low:
            raise SdoAbort(Abort.VALUE_LOW)


def read_entries(od: ObjectDictionary) -> Iterator[Entry]:
    """Every entry of a parsed EDS, the dummy types 0001h–0007h that DummyUsage allows included."""
    for item in od.indices.values():
        members = (item,) if isinstance(item, ODVariable) else item.subindices.values()
        for variable in members:
            yield _entry(variable)


def _entry(variable: ODVariable) -> Entry:
    data_type = variable.data_type or 0
    bits = _UNSIGNED.get(data_type) or _SIGNED.get(data_type) or {0x08: 32, 0x11: 64}.get(data_type, 0)
    access = variable.access_type
    dummy = variable.index <= 0x0007
    return Entry(
        key=key_of(variable.index, variable.subindex),
        name=variable.qualname,
        bits=bits,
        signed=data_type in _SIGNED,
        real=_FLOAT.get(data_type, ""),
        readable="r" in access or access == "const",
        writable="w" in access,
        in_tpdo=variable.pdo_mappable and not dummy and access not in {"wo", "rww"},
        in_rpdo=dummy or (variable.pdo_mappable and access in {"rw", "wo", "rww"}),
        low=variable.min,
        high=variable.max,
        default=_default(variable, bits),
    )


def _default(variable: ODVariable, bits: int) -> Value:
    value = variable.value if variable.value is not None else variable.default
    if value is None:
        return 0 if bits else b""
    if isinstance(value, str):
        unicode = variable.data_type == datatypes.UNICODE_STRING
        return value.encode("utf-16-le") if unicode else value.encode("latin-1", "replace")
    return bytes(value) if isinstance(value, (bytes, bytearray)) else value
