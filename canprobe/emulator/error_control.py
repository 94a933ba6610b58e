"""Heartbeat producer and consumer.

Source: CiA 301, "Error control services", objects 1016h and 1017h.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from canprobe.emulator.aborts import Abort, SdoAbort
from canprobe.emulator.core import NO_ROUTES, NodeCore, Route
from canprobe.emulator.emergency import Emergency
from canprobe.emulator.entries import Value
from canprobe.emulator.timers import Timer
from canprobe.protocol.emcy import HEARTBEAT_LOST
from canprobe.protocol.frames import HEARTBEAT_BASE, NmtState, pack_heartbeat


class HeartbeatProducer:
    """Tells the NMT state every 1017h milliseconds, and at once when it changes or 1017h is written."""

    def __init__(self, core: NodeCore) -> None:
        self._core = core
        self._timer = core.timers.new(self._due)
        self._period_ns = 0
        core.dictionary.on_write(0x1017, lambda _sub, _value: self._begin(core.now_ns))

    def reset(self, t_ns: int) -> None:
        """The boot-up message stands for the first heartbeat."""
        self._period_ns = self._core.dictionary.number(0x1017) * 1_000_000
        self._timer.cancel()

    def entered(self, t_ns: int) -> None:
        """Boot-up out of initialisation, else a heartbeat with the new state."""
        self._begin(t_ns)

    def boot_up(self, t_ns: int) -> None:
        """Send the boot-up message, which is the first heartbeat."""
        self._core.send(*pack_heartbeat(self._core.node_id, NmtState.INITIALISING))
        if self._period_ns:
            self._timer.arm(t_ns + self._period_ns)

    def routes(self) -> Mapping[int, Route]:
        """A producer listens to nothing."""
        return NO_ROUTES

    def _begin(self, t_ns: int) -> None:
        self._period_ns = self._core.dictionary.number(0x1017) * 1_000_000
        self._timer.cancel()
        if self._period_ns:
            self._beat()
            self._timer.arm(t_ns + self._period_ns)

    def _beat(self) -> None:
        self._core.send(*pack_heartbeat(self._core.node_id, self._core.state))

    def _due(self, due_ns: int) -> None:
        self._beat()
        self._timer.arm_next(due_ns, self._period_ns)


class HeartbeatConsumer:
    """Watches the producers of 1016h, each from its first heartbeat on."""

    def __init__(self, core: NodeCore, emcy: Emergency, on_loss: Callable[[int], None]) -> None:
        """`on_loss(t_ns)` is called when a producer is lost."""
        self._core, self._emcy, self._on_loss = core, emcy, on_loss
        self._timers: dict[int, Timer] = {}
        self._periods: dict[int, int] = {}
        core.dictionary.on_check(0x1016, self._check)
        core.dictionary.on_write(0x1016, lambda _sub, _value: self._configure())

    def reset(self, t_ns: int) -> None:
        """Read 1016h; nobody has been heard."""
        self._configure()

    def entered(self, t_ns: int) -> None:
        """Error control runs in every state."""

    def routes(self) -> Mapping[int, Route]:
        """Heartbeat identifiers of the producers watched."""
        if self._core.state is NmtState.INITIALISING:
            return NO_ROUTES
        return {HEARTBEAT_BASE + node_id: self._heard(node_id) for node_id in self._periods}

    def _entries(self) -> dict[int, tuple[int, int]]:
        """Subindex → (node id, period in ms) of the entries in use."""
        number, found = self._core.dictionary.number, {}
        for subindex in range(1, 128):
            word = number(0x1016, subindex)
            if 1 <= word >> 16 & 0xFF <= 127 and word & 0xFFFF:
                found[subindex] = word >> 16 & 0xFF, word & 0xFFFF
        return found

    def _configure(self) -> None:
        periods = {node_id: period * 1_000_000 for node_id, period in self._entries().values()}
        for node_id, timer in self._timers.items():
            timer.cancel()
            self._emcy.clear(HEARTBEAT_LOST, node_id)
        self._periods = periods
        self._timers = {node_id: self._core.timers.new(self._timed_out(node_id)) for node_id in periods}
        self._core.reroute()

    def _heard(self, node_id: int) -> Route:
        timer, period = self._timers[node_id], self._periods[node_id]

        def heard(data: bytes, t_ns: int) -> None:
            if len(data) != 1:
                return
            timer.arm(t_ns + period)
            if self._emcy.any:
                self._emcy.clear(HEARTBEAT_LOST, node_id)

        return heard

    def _timed_out(self, node_id: int) -> Callable[[int], None]:
        def timed_out(due_ns: int) -> None:
            self._emcy.report(HEARTBEAT_LOST, bytes((node_id,)), source=node_id)
            self._on_loss(due_ns)

        return timed_out

    def _check(self, subindex: int, value: Value) -> None:
        node_id, period = int(value) >> 16 & 0xFF, int(value) & 0xFFFF
        if subindex == 0 or not (node_id and period):
            return
        others = {node for sub, (node, _) in self._entries().items() if sub != subindex}
        if node_id in others or node_id > 127:
            raise SdoAbort(Abort.PARAMETER_INCOMPATIBLE)
