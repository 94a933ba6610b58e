"""One entry of the object dictionary: type, rights, limits, and the bytes of a value.

Source: CiA 301, "Data type entry usage" and "Object dictionary", EDS keywords of CiA 306.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, fields
from operator import attrgetter

from canopen.objectdictionary import ObjectDictionary, datatypes

from canprobe.fieldbus.eds.description import DescribedEntry, Description
from canprobe.fieldbus.eds.values import REAL_FORMS
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

Value = int | float | bytes
_STATED = [field.name for field in fields(DescribedEntry)]
_states = attrgetter(*_STATED)


def key_of(index: int, subindex: int = 0) -> int:
    """Dictionary key of an index and a subindex."""
    return index << 8 | subindex


@dataclass(frozen=True, slots=True)
class Entry(DescribedEntry):
    """One addressable value, as the EDS describes it.

    Attributes:
        default: value after a reset, that of a DCF where there is one.
        key: index << 8 | subindex.
        real: struct format of a REAL32 or REAL64; empty for other types.
    """

    default: Value
    key: int
    real: str

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
    for described in Description(od).entries():
        stated = dict(zip(_STATED, _states(described), strict=True)) | {"default": _default(described)}
        real = REAL_FORMS[described.data_type][0] if described.data_type in REAL_FORMS else ""
        yield Entry(**stated, key=key_of(*described.place), real=real)


def _default(described: DescribedEntry) -> Value:
    value, bits = described.initial, described.bits
    if value is None:
        return 0 if bits else b""
    if isinstance(value, str):
        unicode = described.data_type == datatypes.UNICODE_STRING
        return value.encode("utf-16-le") if unicode else value.encode("latin-1", "replace")
    return int.from_bytes(value, "little") if bits and isinstance(value, bytes) else value
