"""The object dictionary of a node: its entries, as the EDS describes them, and their values, with the checks that an
access over the bus must pass.

Services add their rules: a *check* may refuse a value before it is stored, a *hook* acts after that, and a *refresh*
brings a value up to date before it is read.
Source: CiA 301, "Data type entry usage" and "Object dictionary", EDS keywords of CiA 306.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from operator import attrgetter

from canopen.objectdictionary import ObjectDictionary, datatypes

from canprobe.fieldbus.bus.port import nothing
from canprobe.fieldbus.eds.description import DescribedEntry, Description
from canprobe.fieldbus.eds.packaged import KNOWN_NAMES
from canprobe.fieldbus.eds.values import REAL_FORMS
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

Value = int | float | bytes
_STATED = [field.name for field in fields(DescribedEntry)]
_states = attrgetter(*_STATED)
Check = Callable[[int, Value], None]
Hook = Callable[[int, Value], None]
Slot = tuple[int, int, float, float, tuple[Check, ...], tuple[Hook, ...]]
"""Destination of a value of a cyclic RPDO, looked up once: key, subindex, least, greatest, checks, hooks."""
_BEYOND_INTEGERS = 1 << 64
"""Limit beyond every integer; a comparison with it takes half the time of one with infinity."""


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


class Dictionary:
    """The object dictionary of one node.

    Attributes:
        entries: entries by key (index << 8 | subindex).
        values: present values by key; cyclic code reads and writes them directly.
        written: function that is called with the keys of values that were stored together: one over SDO, or those of an
            RPDO that are `watched`.
        watched: keys for which `written` is called when an RPDO brings them.
        configured: function that is called with the index after a value was stored over SDO.
    """

    def __init__(self, od: ObjectDictionary) -> None:
        self.entries: dict[int, Entry] = {entry.key: entry for entry in read_entries(od)}
        self.values: dict[int, Value] = {}
        self._own: dict[int, Value] = {}
        self._indices = {key >> 8 for key in self.entries}
        self._checks: dict[int, list[Check]] = {}
        self._hooks: dict[int, list[Hook]] = {}
        self._refreshers: dict[int, Callable[[int], None]] = {}
        self.written: Callable[[Sequence[int]], None] = nothing
        self.watched: Container[int] = ()
        self.configured: Callable[[int], None] = nothing
        self.restore(self.entries)

    def restore(self, keys: Iterable[int]) -> None:
        """Put the defaults of the EDS back, without checks or hooks."""
        for key in keys:
            self.values[key] = self.entries[key].default

    def set_default(self, index: int, subindex: int, value: Value) -> None:
        """Give an entry a default that only this device has, such as a serial number. Raises KeyError without one."""
        key = key_of(index, subindex)
        self._own[key] = value
        self.entries[key] = replace(self.entries[key], default=value)
        self.values[key] = value

    def take_defaults(self, od: ObjectDictionary) -> None:
        """Take the defaults of the same EDS for another node id; present values stay until they are restored."""
        for entry in read_entries(od):
            self.entries[entry.key] = replace(entry, default=self._own.get(entry.key, entry.default))

    def __contains__(self, key: int) -> bool:
        return key in self.entries

    def has_index(self, index: int) -> bool:
        """Whether any entry of that index exists."""
        return index in self._indices

    def indices_in(self, area: range) -> list[int]:
        """Indices in an area, ascending."""
        return sorted(index for index in self._indices if index in area)

    def has_known(self, index: int) -> bool:
        """Whether the device has the object of `KNOWN_NAMES` at this index."""
        entry = self.entries.get(key_of(index))
        return entry is not None and entry.name == KNOWN_NAMES[index]

    def number(self, index: int, subindex: int = 0, default: int = 0) -> int:
        """An integer value, or `default` where the EDS has no such entry."""
        value = self.values.get(key_of(index, subindex), default)
        return int(value) if not isinstance(value, bytes) else default

    def delivered(self, index: int, subindex: int = 0) -> int:
        """The integer value that an entry has after a reset with nothing stored; 0 where the EDS has no such entry."""
        entry = self.entries.get(key_of(index, subindex))
        return 0 if entry is None or isinstance(entry.default, bytes) else int(entry.default)

    def put(self, index: int, subindex: int, value: Value) -> None:
        """Store a value that the device itself makes; nothing happens where the EDS has no such entry."""
        key = key_of(index, subindex)
        if key in self.entries:
            self.values[key] = value

    def on_check(self, index: int, check: Check) -> None:
        """Call `check(subindex, value)` before a value of `index` is stored; it may raise SdoAbort."""
        self._checks.setdefault(index, []).append(check)

    def on_write(self, index: int, hook: Hook) -> None:
        """Call `hook(subindex, value)` after a value of `index` was stored over SDO or RPDO."""
        self._hooks.setdefault(index, []).append(hook)

    def on_change(self, act: Callable[[], None], *indices: int) -> None:
        """Call `act()` after a value of one of the indices was stored over SDO or RPDO."""
        for index in indices:
            self.on_write(index, lambda _subindex, _value: act())

    def on_read(self, index: int, refresh: Callable[[int], None]) -> None:
        """Call `refresh(subindex)` before a value of `index` is read over SDO; it may raise SdoAbort."""
        self._refreshers[index] = refresh

    def slot(self, key: int) -> Slot:
        """Slot of a value for cyclic RPDOs. It does not have hooks and checks that are added later."""
        entry, index = self.entries[key], key >> 8
        low = -_BEYOND_INTEGERS if entry.low is None else entry.low
        high = _BEYOND_INTEGERS if entry.high is None else entry.high
        return key, key & 0xFF, low, high, tuple(self._checks.get(index, ())), tuple(self._hooks.get(index, ()))

    def find(self, index: int, subindex: int) -> Entry:
        """The entry. Raises SdoAbort where there is no such object or subindex."""
        entry = self.entries.get(key_of(index, subindex))
        if entry is None:
            raise SdoAbort(Abort.NO_SUBINDEX if index in self._indices else Abort.NO_OBJECT)
        return entry

    def find_writable(self, index: int, subindex: int) -> Entry:
        """The entry. Raises SdoAbort where there is none, or it is read-only."""
        entry = self.find(index, subindex)
        if not entry.writable:
            raise SdoAbort(Abort.READ_ONLY)
        return entry

    def read(self, index: int, subindex: int) -> bytes:
        """Read a value for an SDO upload. Raises SdoAbort."""
        entry = self.entries.get(index << 8 | subindex) or self.find(index, subindex)
        if not entry.readable:
            raise SdoAbort(Abort.WRITE_ONLY)
        if refresh := self._refreshers.get(index):
            refresh(subindex)
        return entry.to_bytes(self.values[entry.key])

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write a value of an SDO download. Raises SdoAbort; the value is then unchanged."""
        entry = self.find_writable(index, subindex)
        self.write_value(entry, entry.from_bytes(data))

    def write_value(self, entry: Entry, value: Value) -> None:
        """Check limits and checks, store, call the hooks: the common end of SDO and RPDO. Raises SdoAbort."""
        index, subindex = entry.key >> 8, entry.key & 0xFF
        entry.check_limits(value)
        for check in self._checks.get(index, ()):
            check(subindex, value)
        self.values[entry.key] = value
        for hook in self._hooks.get(index, ()):
            hook(subindex, value)
        self.written((entry.key,))
