"""One RPDO and one TPDO: what may be written to their parameters, reception, events, packing.

Source: CiA 301, objects 1400h–1BFFh (RPDO and TPDO communication and mapping parameter), "PDO mapping".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

from canprobe.fieldbus.eds.packaged import LONG_PDOS, LONG_PDOS_NAME
from canprobe.fieldbus.node.core import INVALID, NO_RTR, NodeCore, check_cob_id
from canprobe.fieldbus.node.dictionary import Abort, Dictionary, SdoAbort, Slot, Value, key_of
from canprobe.fieldbus.node.emcy import Emergency
from canprobe.fieldbus.protocol.frames import PDO_TOO_LONG, PDO_TOO_SHORT, RPDO_TIMEOUT, RTR_FLAG
from canprobe.fieldbus.protocol.pdo import FD_MAX_BITS, MAX_BITS, PdoEntry, PdoLayout

# What may be written to PDO communication and mapping parameters, and when.

COB_ID, TYPE, INHIBIT, EVENT, START = 1, 2, 3, 5, 6
_RESERVED_RPDO = range(0xF1, 0xFE)
_RESERVED_TPDO = range(0xF1, 0xFC)


@dataclass(frozen=True, slots=True)
class PdoRules:
    """Rules of one PDO.

    Attributes:
        dictionary: the node's.
        communication, mapping: indices of its two parameter records.
        transmits: TPDO or RPDO.
    """

    dictionary: Dictionary
    communication: int
    mapping: int
    transmits: bool

    @property
    def valid(self) -> bool:
        """Whether the PDO exists now (bit 31 of its COB-ID is 0)."""
        return not self.dictionary.number(self.communication, COB_ID, INVALID) & INVALID

    @property
    def long(self) -> bool:
        """Whether PDOs of up to 64 bytes were switched on, in a device that has them."""
        dictionary = self.dictionary
        return self.transmits and dictionary.has_named(LONG_PDOS, LONG_PDOS_NAME) and bool(dictionary.number(LONG_PDOS))

    def check_communication(self, subindex: int, value: Value) -> None:
        """Raises SdoAbort for a value that the standard forbids now."""
        new, old = int(value), self.dictionary.number(self.communication, subindex)
        if subindex == COB_ID:
            check_cob_id(new, old)
        elif subindex == TYPE:
            if new in (_RESERVED_TPDO if self.transmits else _RESERVED_RPDO):
                raise SdoAbort(Abort.VALUE)
        elif subindex in (INHIBIT, START):
            too_big = subindex == START and new > 240
            if too_big or (self.valid and new != old):
                raise SdoAbort(Abort.VALUE)

    def check_mapping(self, subindex: int, value: Value) -> None:
        """Raises SdoAbort for a mapping that cannot be, or cannot be changed now."""
        new, old = int(value), self.dictionary.number(self.mapping, subindex)
        if new == old:
            return
        if self.valid or (subindex and self.dictionary.number(self.mapping, 0)):
            raise SdoAbort(Abort.UNSUPPORTED_ACCESS)
        if subindex == 0:
            self.entries(new)
        elif new:
            self.entry(new)

    def entries(self, count: int | None = None, fixed: bool = False) -> tuple[PdoEntry, ...]:
        """The first `count` mapped entries (all: None). Raises SdoAbort when they do not make a PDO."""
        total = self.dictionary.number(self.mapping, 0) if count is None else count
        if total and key_of(self.mapping, total) not in self.dictionary:
            raise SdoAbort(Abort.MAPPING_LENGTH)
        found = tuple(self.entry(self.dictionary.number(self.mapping, sub), fixed) for sub in range(1, total + 1))
        if sum(entry.bits for entry in found) > (FD_MAX_BITS if self.long else MAX_BITS):
            raise SdoAbort(Abort.MAPPING_LENGTH)
        return found

    def present(self) -> tuple[PdoEntry, ...]:
        """All mapped entries; none where the mapping makes no sense."""
        try:
            return self.entries(fixed=True)
        except SdoAbort:
            return ()

    def entry(self, word: int, fixed: bool = False) -> PdoEntry:
        """One mapping word. Raises SdoAbort when its object does not exist, may not be mapped or has another length.

        What is there already may map anything: an EDS often does not list as mappable what a fixed mapping holds.
        """
        target = self.dictionary.entries.get(word >> 8)
        mappable = target is not None and (fixed or (target.in_tpdo if self.transmits else target.in_rpdo))
        if target is None or not mappable or target.real or not target.bits or target.bits != word & 0xFF:
            raise SdoAbort(Abort.NOT_MAPPABLE)
        return PdoEntry.from_word(word, target.signed, target.name)


# One RPDO: reception, length check, event timer, and what happens to its values.
#
# Source: CiA 301, "RPDO", objects 1400h and 1600h; errors 8210h, 8220h, 8250h.


class Rpdo:
    """One receive PDO, compiled from its parameters by `configure`.

    Attributes:
        cob_id: identifier, or None while the PDO is not valid.
        keys: mapped dictionary keys, dummies left out.
        synchronous: applied at the next SYNC (types 0–240).
        pending: values waiting for that SYNC.
    """

    def __init__(self, core: NodeCore, emcy: Emergency, rules: PdoRules) -> None:
        self._core, self._emcy, self._rules = core, emcy, rules
        self._timer = core.timers.new(self._timed_out)
        self._layout = PdoLayout(0, ())
        self._unpack = self._layout.raw_unpack
        self._slots: tuple[Slot, ...] = ()
        self.keys: tuple[int, ...] = ()
        self._event_ns = 0
        self.cob_id: int | None = None
        self.synchronous = False
        self.pending: tuple[int, ...] | None = None

    def configure(self) -> None:
        """Read the parameters. A mapping that makes no sense leaves the PDO without values."""
        dictionary, index = self._core.dictionary, self._rules.communication
        self.stop()
        if self._emcy.any:
            self._forgive()  # what was wrong with the old parameters
        self.cob_id = dictionary.number(index, COB_ID) & 0x7FF if self._rules.valid else None
        self._layout = PdoLayout(self.cob_id or 0, self._rules.present())
        self._unpack = self._layout.raw_unpack  # the length is checked before
        self.keys = tuple(key_of(signal.index, signal.subindex) for signal in self._layout.signals)
        self._slots = tuple(dictionary.slot(key) for key in self.keys)
        self.synchronous = dictionary.number(index, TYPE) <= 240
        self._event_ns = dictionary.number(index, EVENT) * 1_000_000

    @property
    def patient(self) -> bool:
        """Nothing has to be done about a frame before the next SYNC."""
        return self.synchronous and not self._event_ns

    def stop(self) -> None:
        """Forget what waits; the event timer starts again at the next reception."""
        self.pending = None
        self._timer.cancel()

    def receive(self, data: bytes, t_ns: int) -> None:
        """A frame with this PDO's identifier."""
        length = self._layout.length
        if len(data) != length:
            if len(data) < length:
                self._emcy.report(PDO_TOO_SHORT, source=self)
                return
            self._emcy.report(PDO_TOO_LONG, source=self)
            data = data[:length]
        elif self._emcy.any:
            self._forgive()
        if self._event_ns:
            self._timer.arm(t_ns + self._event_ns)
        self.take(self._unpack(data))

    def take(self, values: tuple[int, ...]) -> None:
        """One value for each mapped entry but the dummies, for now or for the next SYNC."""
        if self.synchronous:
            self.pending = values
        else:
            self.apply(values)

    def apply(self, given: tuple[int, ...]) -> None:
        """Store the values, each as `Dictionary.write_value` does; one that it would refuse is dropped."""
        self.pending = None
        dictionary, reported = self._core.dictionary, []
        values, watched = dictionary.values, dictionary.watched
        for value, (key, subindex, low, high, checks, hooks) in zip(given, self._slots, strict=True):
            if not low <= value <= high:
                continue
            try:
                for check in checks:
                    check(subindex, value)
                values[key] = value
                for hook in hooks:
                    hook(subindex, value)
            except SdoAbort:
                continue
            if key in watched:
                reported.append(key)
        if reported:
            dictionary.written(reported)

    def _forgive(self) -> None:
        for code in (PDO_TOO_SHORT, PDO_TOO_LONG, RPDO_TIMEOUT):
            self._emcy.clear(code, self)
        self._emcy.clear(RPDO_TIMEOUT)  # a drive's, which misses targets whatever PDO brings them

    def _timed_out(self, due_ns: int) -> None:
        self._emcy.report(RPDO_TIMEOUT, source=self)


# One TPDO: packing, and the events and remote requests that send it outside the SYNC cycle.
#
# Source: CiA 301, "TPDO", objects 1800h and 1A00h.

BUFFERED, ON_REQUEST = 252, 253

Sampler = Callable[[int], None]
Fetch = Callable[[Mapping[int, Any]], tuple[int, ...]]
Packing = tuple[int, Callable[..., bytes], Fetch]
"""Identifier, what packs the values, what takes them from the dictionary."""


def _fetcher(keys: tuple[int, ...]) -> Fetch:
    """All mapped values at once, by one call into C."""
    if len(keys) == 1:
        return lambda values, key=keys[0]: (values[key],)  # type: ignore[misc]
    return itemgetter(*keys)


class Tpdo:
    """One transmit PDO, compiled from its parameters by `configure`.

    Attributes:
        active: valid and with something mapped.
        samplers: bring what is mapped up to date, each by `sampler(t_ns)`.
        keys: mapped dictionary keys.
        packing: how to make the frame; of an active PDO.
        type: transmission type.
        start: SYNC start value (18xxh:06).
        remote_id: identifier of the remote request that is answered, or None.
        requested: an event waits for the next SYNC (type 0).
    """

    def __init__(self, core: NodeCore, rules: PdoRules) -> None:
        self._core, self._rules = core, rules
        self._event_timer = core.timers.new(self._event_due)
        self._inhibit_timer = core.timers.new(self._send_now)
        self._layout = PdoLayout(0, ())
        self.packing: Packing = 0, self._layout.raw_pack, lambda _values: ()
        self._cob_id = self._event_ns = self._inhibit_ns = self._earliest_ns = 0
        self.active = self.requested = False
        self._buffer: bytes | None = None
        self.keys: tuple[int, ...] = ()
        self.remote_id: int | None = None
        self.type = self.start = 0
        self.samplers: Sequence[Sampler] = ()

    def configure(self) -> None:
        """Read the parameters. A mapping that makes no sense leaves the PDO silent."""
        number, index, entries = self._core.dictionary.number, self._rules.communication, self._rules.present()
        self.stop()
        cob_id = number(index, COB_ID)
        self._cob_id = cob_id & 0x7FF
        self.active = self._rules.valid and bool(entries)
        self.remote_id = self._cob_id | RTR_FLAG if self.active and not cob_id & NO_RTR else None
        self.keys = tuple(key_of(entry.index, entry.subindex) for entry in entries)
        self.type, self.start = number(index, TYPE), number(index, START)
        self._inhibit_ns = number(index, INHIBIT) * 100_000
        self._event_ns = number(index, EVENT) * 1_000_000
        if self.active:
            self._layout = PdoLayout(self._cob_id, entries, self.type, fd=True)
            self.packing = self._cob_id, self._layout.raw_pack, _fetcher(self.keys)

    @property
    def by_event(self) -> bool:
        """Sent on events at once (254, 255), not at a SYNC."""
        return self.type >= 254

    def stop(self) -> None:
        """No longer operational: nothing is due."""
        self._event_timer.cancel()
        self._inhibit_timer.cancel()
        self.requested = False
        self._buffer = None

    def started(self, t_ns: int) -> None:
        """Operational: an event-driven PDO sends its first values."""
        if self.active and self.by_event:
            self._earliest_ns = t_ns
            self.event(t_ns)

    def reconfigured(self, t_ns: int) -> None:
        """New parameters in operational: the event timer runs from now on."""
        if self.active and self.by_event and self._event_ns:
            self._event_timer.arm(t_ns + self._event_ns)

    def event(self, t_ns: int) -> None:
        """A mapped value changed."""
        if not self.active:
            return
        if not self.by_event:
            self.requested = self.type == 0
        elif t_ns >= self._earliest_ns:
            self._send_now(t_ns)
        elif self._inhibit_timer.due_ns is None:
            self._inhibit_timer.arm(self._earliest_ns)

    def send(self, t_ns: int) -> None:
        """Pack the values of `t_ns` and send them."""
        self.requested = False
        self._core.send(self._cob_id, self._packed(t_ns))

    def sample(self, t_ns: int) -> None:
        """Type 252: pack the values of this SYNC, for the next remote request."""
        self._buffer = self._packed(t_ns)

    def remote(self, data: bytes, t_ns: int) -> None:
        """A remote request. Synchronous PDOs answer with the values of the last SYNC, the others with the present."""
        if self.by_event:
            self.event(t_ns)
        elif self._buffer is not None:
            self._core.send(self._cob_id, self._buffer)
        else:  # an event that waits for a SYNC goes on waiting
            self._core.send(self._cob_id, self._packed(t_ns if self.type in (BUFFERED, ON_REQUEST) else None))

    def _packed(self, t_ns: int | None) -> bytes:
        """The values of `t_ns`; None: as they were sampled last."""
        if t_ns is not None:
            for sampler in self.samplers:
                sampler(t_ns)
        return self._layout.pack(*self.packing[2](self._core.dictionary.values))

    def _send_now(self, t_ns: int) -> None:
        self.send(t_ns)
        self._earliest_ns = t_ns + self._inhibit_ns
        if self._event_ns:
            self._event_timer.arm(t_ns + self._event_ns)

    def _event_due(self, due_ns: int) -> None:
        now_ns = self._core.timers.now_ns
        self.event(now_ns if now_ns - due_ns > self._event_ns else due_ns)  # late: do not catch up
