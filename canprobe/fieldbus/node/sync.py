"""SYNC consumer: length, counter, lost SYNCs, and the time-out of the communication cycle period.

Source: CiA 301, "Synchronization object (SYNC)", objects 1005h, 1006h, 1019h; errors 8100h, 8240h.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from canprobe.fieldbus.node.core import TALKING_STATES, NodeCore, Route, Service
from canprobe.fieldbus.node.dictionary import Value
from canprobe.fieldbus.node.emcy import Emergency
from canprobe.fieldbus.protocol.emcy import SYNC_LENGTH_CODE, SYNC_LOST_CODE
from canprobe.fieldbus.protocol.frames import MAX_SYNC_COUNT, SYNC_ID, NmtState, is_restricted
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

_PRODUCER_FLAG = 1 << 30


class SyncConsumer(Service):
    """Checks each SYNC and passes it to the PDOs as `on_sync(t_ns, counter, elapsed)` in operational."""

    states = TALKING_STATES

    def __init__(self, core: NodeCore, emcy: Emergency, on_sync: Callable[[int, int, int], None]) -> None:
        self._core, self._emcy, self._on_sync = core, emcy, on_sync
        # it only reports: a drive stops by a watch of its own, as only it knows in which modes it needs SYNC
        self._timer = core.timers.new(lambda _due_ns: emcy.report(SYNC_LOST_CODE))
        self._overflow = self._timeout_ns = self._last = 0
        self._operational = False
        dictionary = core.dictionary
        dictionary.on_check(0x1005, self._check_cob_id)
        dictionary.on_check(0x1019, self._check_overflow)
        dictionary.on_write(0x1005, lambda _sub, _value: core.reroute())
        dictionary.on_change(self._configure, 0x1006, 0x1019)

    def reset(self, t_ns: int) -> None:
        self._configure()

    def _configure(self) -> None:
        number = self._core.dictionary.number
        self._overflow = number(0x1019)
        self._timeout_ns = number(0x1006) * 1500  # 1.5 periods of 1006h, which is in µs
        self._last = 0
        self._timer.cancel()

    def entered(self, t_ns: int) -> None:
        """Stop the time-out, which runs in operational from the first SYNC on."""
        self._operational = self._core.state is NmtState.OPERATIONAL
        self._timer.cancel()

    def routes(self) -> Mapping[int, Route]:
        """The SYNC identifier."""
        return {self._core.dictionary.number(0x1005, 0, SYNC_ID) & 0x7FF: self._receive}

    def _receive(self, data: bytes, t_ns: int) -> None:
        overflow = self._overflow
        if len(data) != (1 if overflow else 0):
            self._emcy.report(SYNC_LENGTH_CODE)
            return
        if self._emcy.any:
            self._emcy.clear(SYNC_LENGTH_CODE)
            self._emcy.clear(SYNC_LOST_CODE)
        counter, elapsed = 0, 1
        if overflow:
            counter, last = data[0], self._last
            self._last = counter
            if last:
                elapsed = (counter - last) % overflow or overflow
        if self._operational:
            if self._timeout_ns:
                self._timer.arm(t_ns + self._timeout_ns)
            self._on_sync(t_ns, counter, elapsed)

    def _check_cob_id(self, subindex: int, value: Value) -> None:
        new = int(value)
        if new & _PRODUCER_FLAG or new & 0x3FFFF800 or is_restricted(new & 0x7FF):
            raise SdoAbort(Abort.VALUE)

    def _check_overflow(self, subindex: int, value: Value) -> None:
        if int(value) == 1 or int(value) > MAX_SYNC_COUNT:
            raise SdoAbort(Abort.VALUE)
        if self._core.dictionary.number(0x1006):
            raise SdoAbort(Abort.DEVICE_STATE)
