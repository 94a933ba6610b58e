"""One TPDO: packing, and the events and remote requests that send it outside the SYNC cycle.

Source: CiA 301, "TPDO", objects 1800h and 1A00h.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import Any

from canprobe.fieldbus.node.core import NodeCore
from canprobe.fieldbus.node.dictionary import key_of
from canprobe.fieldbus.node.pdo_rules import PdoRules
from canprobe.fieldbus.protocol.frames import RTR_FLAG
from canprobe.fieldbus.protocol.pdo import NO_RTR_FLAG, PdoLayout, PdoSub

BUFFERED_TYPE, ON_REQUEST_TYPE = 252, 253

Sampler = Callable[[int], None]
Fetch = Callable[[Mapping[int, Any]], tuple[int, ...]]
Packing = tuple[int, Callable[..., bytes], Fetch]
"""Identifier, packer of the values, and function that takes them from the dictionary."""


def _fetcher(keys: tuple[int, ...]) -> Fetch:
    """The function that takes all mapped values at once, by one call into C."""
    if len(keys) == 1:
        return lambda values, key=keys[0]: (values[key],)  # type: ignore[misc]
    return itemgetter(*keys)


class Tpdo:
    """One transmit PDO, compiled from its parameters by `configure`.

    Attributes:
        rules: rules for its parameters.
        active: whether the PDO is valid and maps something.
        samplers: functions that bring mapped values up to date, each called as `sampler(t_ns)`.
        layout: its mapping, while it is active.
        keys: mapped dictionary keys.
        packing: identifier, packer and source of the values of an active PDO.
        type: transmission type.
        start: SYNC start value (18xxh:06).
        remote_id: identifier of the remote request that is answered, or None.
        requested: whether an event waits for the next SYNC (type 0).
    """

    def __init__(self, core: NodeCore, rules: PdoRules) -> None:
        self._core, self.rules = core, rules
        self._event_timer = core.timers.new(self._event_due)
        self._inhibit_timer = core.timers.new(self._send_now)
        self.layout = PdoLayout(0, ())
        self.packing: Packing = 0, self.layout.raw_pack, lambda _values: ()
        self._cob_id = self._event_ns = self._inhibit_ns = self._earliest_ns = 0
        self.active = self.requested = False
        self._buffer: bytes | None = None
        self.keys: tuple[int, ...] = ()
        self.remote_id: int | None = None
        self.type = self.start = 0
        self.samplers: Sequence[Sampler] = ()

    def configure(self) -> None:
        """Read the parameters. A PDO with an impossible mapping stays silent."""
        number, index, entries = self._core.dictionary.number, self.rules.communication, self.rules.present()
        self.stop()  # what waits was asked for by the parameters before
        cob_id = number(index, PdoSub.COB_ID)
        self._cob_id = cob_id & 0x7FF
        self.active = self.rules.valid and bool(entries)
        self.remote_id = self._cob_id | RTR_FLAG if self.active and not cob_id & NO_RTR_FLAG else None
        self.keys = tuple(key_of(entry.index, entry.subindex) for entry in entries)
        self.type, self.start = number(index, PdoSub.TYPE), number(index, PdoSub.SYNC_START)
        self._inhibit_ns = number(index, PdoSub.INHIBIT_TIME) * 100_000
        self._event_ns = number(index, PdoSub.EVENT_TIMER) * 1_000_000
        if self.active:
            self.layout = PdoLayout(self._cob_id, entries, self.type, fd=True)
            self.packing = self._cob_id, self.layout.raw_pack, _fetcher(self.keys)

    @property
    def by_event(self) -> bool:
        """Whether it is sent at once on events (254, 255), not at a SYNC."""
        return self.type >= 254

    def stop(self) -> None:
        """Stop, as the node is no longer operational: nothing is due."""
        self._event_timer.cancel()
        self._inhibit_timer.cancel()
        self.requested = False
        self._buffer = None

    def started(self, t_ns: int) -> None:
        """Start, as the node is operational: an event-driven PDO sends its first values."""
        if self.active and self.by_event:
            self._earliest_ns = t_ns
            self.event(t_ns)

    def reconfigured(self, t_ns: int) -> None:
        """Let the event timer run from now on, as there are new parameters in operational."""
        if self.active and self.by_event and self._event_ns:
            self._event_timer.arm(t_ns + self._event_ns)

    def event(self, t_ns: int) -> None:
        """Report that a mapped value changed."""
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
        """Pack the values of this SYNC for the next remote request (type 252)."""
        self._buffer = self._packed(t_ns)

    def remote(self, data: bytes, t_ns: int) -> None:
        """Answer a remote request: synchronous PDOs with the values of the last SYNC, others with present ones."""
        if self.by_event:
            self.event(t_ns)
        elif self._buffer is not None:
            self._core.send(self._cob_id, self._buffer)
        else:  # an event that waits for a SYNC still waits
            self._core.send(self._cob_id, self._packed(t_ns if self.type in (BUFFERED_TYPE, ON_REQUEST_TYPE) else None))

    def _packed(self, t_ns: int | None) -> bytes:
        """Pack the values of `t_ns`; None: those that were sampled last."""
        if t_ns is not None:
            for sampler in self.samplers:
                sampler(t_ns)
        return self.layout.pack(*self.packing[2](self._core.dictionary.values))

    def _send_now(self, t_ns: int) -> None:
        self.send(t_ns)
        self._earliest_ns = t_ns + self._inhibit_ns
        if self._event_ns:
            self._event_timer.arm(t_ns + self._event_ns)

    def _event_due(self, due_ns: int) -> None:
        now_ns = self._core.timers.now_ns
        self.event(now_ns if now_ns - due_ns > self._event_ns else due_ns)  # late: no catching up
