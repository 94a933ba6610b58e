"""One entry of the object dictionary: type, rights, limits, and the bytes of a value.

Source: CiA 301, "Data type entry usage" and "Object dictionary", EDS keywords of CiA 306.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from canopen.objectdictionary import ObjectDictionary, datatypes

from canprobe.fieldbus.eds.description import LAST_DUMMY, DescribedEntry, Description
from canprobe.fieldbus.eds.values import REAL_FORMS
from canprobe.fieldbus.node.abort import Abort, SdoAbort

Value = int | float | bytes


def key_of(index: int, subindex: int = 0) -> int:
    """Dictionary key of an index and a subindex."""
    return index << 8 | subindex


@dataclass(frozen=True, slots=True)
class Entry:
    """One addressable value.

    Attributes:
        key: index << 8 | subindex.
        name: name in the EDS.
        bits: length of a value of fixed size over SDO; 0 for strings and domains.
        boolean: whether it is a BOOLEAN, which is one bit in a PDO.
        signed: whether an integer is signed.
        real: struct format of a REAL32 or REAL64; empty for other types.
        readable, writable: whether SDO may read and write it.
        in_tpdo, in_rpdo: whether a TPDO, an RPDO may map it.
        low, high: limits in the EDS, or None.
        default: value after a reset.
    """

    key: int
    name: str
    bits: int
    boolean: bool
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
        """Bytes of a value on the wire."""
        if isinstance(value, bytes):
            return value
        if self.real:
            return struct.pack(self.real, value)
        return int(value).to_bytes(self.bits // 8, "little", signed=self.signed)

    def from_bytes(self, data: bytes) -> Value:
        """Value of bytes on the wire. Raises SdoAbort when the length is not the object's."""
        if not self.bits:
            return bytes(data)
        self.check_size(len(data))
        if self.real:
            number: float = struct.unpack(self.real, data)[0]
            return number
        return int.from_bytes(data, "little", signed=self.signed)

    def check_size(self, size: int) -> None:
        """Check the size of a value, bytes. Raises SdoAbort when the object has another size."""
        if self.bits and size * 8 != self.bits:
            raise SdoAbort(Abort.TOO_LONG if size * 8 > self.bits else Abort.TOO_SHORT)

    def check_limits(self, value: Value) -> None:
        """Check a value against the limits of the EDS. Raises SdoAbort when it is outside."""
        if isinstance(value, bytes):
            return
        if self.high is not None and value > self.high:
            raise SdoAbort(Abort.VALUE_HIGH)
        if self.low is not None and value < self.low:
            raise SdoAbort(Abort.VALUE_LOW)


def read_entries(od: ObjectDictionary) -> Iterator[Entry]:
    """Every entry of a parsed EDS, with the dummy types 0001h–0007h that DummyUsage allows."""
    return map(_entry, Description(od).entries())


def _entry(described: DescribedEntry) -> Entry:
    data_type = described.data_type
    bits = 8 if data_type == datatypes.BOOLEAN else described.bits
    return Entry(
        key=key_of(described.index, described.subindex),
        name=described.name,
        bits=bits,
        boolean=data_type == datatypes.BOOLEAN,
        signed=described.signed,
        real=REAL_FORMS[data_type][0] if data_type in REAL_FORMS else "",
        readable=described.readable,
        writable=described.writable,
        in_tpdo=described.in_tpdo and described.index > LAST_DUMMY,
        in_rpdo=described.in_rpdo,
        low=described.low,
        high=described.high,
        default=_default(described, bits),
    )


def _default(described: DescribedEntry, bits: int) -> Value:
    value = described.initial
    if value is None:
        return 0 if bits else b""
    if isinstance(value, str):
        unicode = described.data_type == datatypes.UNICODE_STRING
        return value.encode("utf-16-le") if unicode else value.encode("latin-1", "replace")
    return int.from_bytes(value, "little") if bits and isinstance(value, bytes) else value
