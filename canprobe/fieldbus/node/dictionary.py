"""Values of a node's object dictionary, with the checks an access over the bus must pass.

Services hang their rules here: a *check* may refuse a value before it is stored, a *hook* acts after, a *refresh*
brings a live value up to date before it is read.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

from canopen.objectdictionary import ObjectDictionary, datatypes

from canprobe.errors import ProtocolError
from canprobe.fieldbus.eds.description import LAST_DUMMY, Description
from canprobe.fieldbus.eds.description import Entry as Described
from canprobe.fieldbus.eds.variables import REALS, SIGNED, UNSIGNED

# SDO abort codes, and the exception that carries one from an access to the server.
#
# Source: CiA 301, table "SDO abort codes" (clause SDO abort transfer protocol).


class Abort(IntEnum):
    """SDO abort codes that a node here can answer with."""

    TOGGLE = 0x05030000
    TIMED_OUT = 0x05040000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE = 0x05040003
    CRC = 0x05040004
    MEMORY = 0x05040005
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    MAPPING_LENGTH = 0x06040042
    PARAMETER_INCOMPATIBLE = 0x06040043
    HARDWARE = 0x06060000
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE = 0x06090030
    VALUE_HIGH = 0x06090031
    VALUE_LOW = 0x06090032
    GENERAL = 0x08000000
    CANNOT_STORE = 0x08000020
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


class SdoAbort(ProtocolError):  # noqa: N818 - the standard's word
    """An access that the dictionary refuses.

    Attributes:
        code: the abort code that goes to the client.
    """

    def __init__(self, code: Abort) -> None:
        self.code = code
        super().__init__(f"{code.name.lower().replace('_', ' ')} ({code:08X}h)")


def nothing(*_: object) -> None:
    """Does nothing: what a callback is until somebody sets it."""


# One entry of the object dictionary: its type, its rights, its limits, and the bytes of a value.
#
# Source: CiA 301, "Data type entry usage" and "Object dictionary", EDS keywords of CiA 306.

Value = int | float | bytes


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
        self.check_size(len(data))
        if self.real:
            number: float = struct.unpack(self.real, data)[0]
            return number
        return int.from_bytes(data, "little", signed=self.signed)

    def check_size(self, size: int) -> None:
        """Raises SdoAbort when a value of a fixed size has another size than `size` bytes."""
        if self.bits and size * 8 != self.bits:
            raise SdoAbort(Abort.TOO_LONG if size * 8 > self.bits else Abort.TOO_SHORT)

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
    return map(_entry, Description(od).entries())


def _entry(described: Described) -> Entry:
    data_type = described.data_type
    number = data_type in SIGNED or data_type in UNSIGNED or data_type in REALS
    bits = 8 if data_type == datatypes.BOOLEAN else described.bits if number else 0
    return Entry(
        key=key_of(described.index, described.subindex),
        name=described.name,
        bits=bits,
        signed=described.signed,
        real=REALS[data_type][0] if data_type in REALS else "",
        readable=described.readable,
        writable=described.writable,
        in_tpdo=described.in_tpdo and described.index > LAST_DUMMY,
        in_rpdo=described.in_rpdo,
        low=described.low,
        high=described.high,
        default=_default(described, bits),
    )


def _default(described: Described, bits: int) -> Value:
    value = described.initial
    if value is None:
        return 0 if bits else b""
    if isinstance(value, str):
        unicode = described.data_type == datatypes.UNICODE_STRING
        return value.encode("utf-16-le") if unicode else value.encode("latin-1", "replace")
    return value


# Values of a node's object dictionary, with the checks an access over the bus must pass.

Check = Callable[[int, Value], None]
Hook = Callable[[int, Value], None]
Slot = tuple[int, int, float, float, tuple[Check, ...], tuple[Hook, ...]]
"""Where a value of a cyclic RPDO goes, looked up once: key, subindex, least, greatest, checks, hooks."""
_ANY = 1 << 64
"""Beyond every integer: compared in half the time of an infinity."""


class Dictionary:
    """The object dictionary of one node.

    Attributes:
        entries: by key (index << 8 | subindex).
        values: present values by key; cyclic code reads and writes here directly.
        written: called with the keys of values that were stored together: one over SDO, or those of an RPDO that are
            `watched`.
        watched: keys of which `written` is called when an RPDO brings them.
        configured: called with the index after a value was stored over SDO.
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
        """Put the EDS's defaults back, without checks or hooks."""
        for key in keys:
            self.values[key] = self.entries[key].default

    def set_default(self, index: int, subindex: int, value: Value) -> None:
        """Give an entry a default of this very device's, such as its serial number. KeyError: no such entry."""
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
        """The indices there, ascending."""
        return sorted(index for index in self._indices if index in area)

    def has_named(self, index: int, name: str) -> bool:
        """Whether the EDS has an object with this name there; of another maker a manufacturer's index is another's."""
        entry = self.entries.get(key_of(index))
        return entry is not None and entry.name == name

    def number(self, index: int, subindex: int = 0, default: int = 0) -> int:
        """An integer value, or `default` where the EDS has no such entry."""
        value = self.values.get(key_of(index, subindex), default)
        return int(value) if not isinstance(value, bytes) else default

    def delivered(self, index: int, subindex: int = 0) -> int:
        """The integer value that an entry has after a reset with nothing stored; 0 where the EDS has no such entry."""
        entry = self.entries.get(key_of(index, subindex))
        return 0 if entry is None or isinstance(entry.default, bytes) else int(entry.default)

    def put(self, index: int, subindex: int, value: Value) -> None:
        """Store a value of the device's own; nothing happens where the EDS has no such entry."""
        key = key_of(index, subindex)
        if key in self.entries:
            self.values[key] = value

    def on_check(self, index: int, check: Check) -> None:
        """`check(subindex, value)` may raise SdoAbort before a value of `index` is stored."""
        self._checks.setdefault(index, []).append(check)

    def on_write(self, index: int, hook: Hook) -> None:
        """`hook(subindex, value)` after a value of `index` was stored over SDO or RPDO."""
        self._hooks.setdefault(index, []).append(hook)

    def on_change(self, act: Callable[[], None], *indices: int) -> None:
        """`act()` after a value of one of the indices was stored over SDO or RPDO."""
        for index in indices:
            self.on_write(index, lambda _subindex, _value: act())

    def on_read(self, index: int, refresh: Callable[[int], None]) -> None:
        """`refresh(subindex)` before a value of `index` is read over SDO; it may raise SdoAbort."""
        self._refreshers[index] = refresh

    def slot(self, key: int) -> Slot:
        """What `write_value` of a cyclic RPDO needs. Hooks and checks hung in later are not seen."""
        entry, index = self.entries[key], key >> 8
        low, high = -_ANY if entry.low is None else entry.low, _ANY if entry.high is None else entry.high
        return key, key & 0xFF, low, high, tuple(self._checks.get(index, ())), tuple(self._hooks.get(index, ()))

    def find(self, index: int, subindex: int) -> Entry:
        """The entry, or SdoAbort: no object, or no such subindex of it."""
        entry = self.entries.get(key_of(index, subindex))
        if entry is None:
            raise SdoAbort(Abort.NO_SUBINDEX if index in self._indices else Abort.NO_OBJECT)
        return entry

    def find_writable(self, index: int, subindex: int) -> Entry:
        """The entry, or SdoAbort also when it is read-only."""
        entry = self.find(index, subindex)
        if not entry.writable:
            raise SdoAbort(Abort.READ_ONLY)
        return entry

    def read(self, index: int, subindex: int) -> bytes:
        """SDO upload. Raises SdoAbort."""
        entry = self.entries.get(index << 8 | subindex) or self.find(index, subindex)
        if not entry.readable:
            raise SdoAbort(Abort.WRITE_ONLY)
        if refresh := self._refreshers.get(index):
            refresh(subindex)
        return entry.to_bytes(self.values[entry.key])

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """SDO download. Raises SdoAbort; the value is then unchanged."""
        entry = self.find_writable(index, subindex)
        self.write_value(entry, entry.from_bytes(data))

    def write_value(self, entry: Entry, value: Value) -> None:
        """Limits, checks, store, hooks: the common end of SDO and RPDO. Raises SdoAbort."""
        index, subindex = entry.key >> 8, entry.key & 0xFF
        entry.check_limits(value)
        for check in self._checks.get(index, ()):
            check(subindex, value)
        self.values[entry.key] = value
        for hook in self._hooks.get(index, ()):
            hook(subindex, value)
        self.written((entry.key,))
