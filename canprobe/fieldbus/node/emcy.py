"""Heartbeat, node guarding and emergencies: how a node reports that it is well, and that it is not.

Source: CiA 301, "Error control services", objects 1016h and 1017h.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Mapping
from functools import partial

from canprobe.fieldbus.node.core import INVALID, NO_ROUTES, NodeCore, Route, Service, Timer, check_cob_id
from canprobe.fieldbus.node.dictionary import Abort, SdoAbort, Value
from canprobe.fieldbus.protocol.frames import (
    HEARTBEAT_BASE,
    HEARTBEAT_LOST,
    NO_ERROR,
    RTR_FLAG,
    Emcy,
    NmtState,
    pack_heartbeat,
)

# EMCY producer, error register 1001h and error history 1003h.
#
# Source: CiA 301, "Emergency object", objects 1001h, 1003h, 1014h, 1015h.

_GENERIC = 0x01
# Bits of 1001h by the first nibble of the code: current, voltage, temperature, communication/profile, manufacturer.
_REGISTER_BITS = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x7: 0x80, 0xF: 0x80}
_SENDING = frozenset({NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL})


def register_bit(code: int) -> int:
    """The bit of the error register 1001h that an emergency error code sets beside the generic one."""
    if code & 0xF000 == 0x8000:
        return 0x10 if code & 0x0F00 <= 0x0200 else 0x20
    return _REGISTER_BITS.get(code >> 12, 0)


_MOST_WAITING = 16
"""Messages kept while the inhibit time runs; of a flood the oldest go."""


class Emergency(Service):
    """Reports errors once, and when they are gone, and remembers them.

    Attributes:
        any: whether any error is present.
    """

    def __init__(self, core: NodeCore) -> None:
        self._core = core
        self._active: dict[int, set[Hashable]] = {}
        self.any = False
        self._history: list[int] = []
        self._waiting: deque[tuple[int, int, bytes]] = deque(maxlen=_MOST_WAITING)
        self._room = sum(1 for key in core.dictionary.entries if key >> 8 == 0x1003 and key & 0xFF)
        self._timer = core.timers.new(self._inhibit_over)
        core.dictionary.on_check(0x1003, self._check_history)
        core.dictionary.on_write(0x1003, self._cleared)
        core.dictionary.on_read(0x1003, self._check_read)
        core.dictionary.on_check(0x1014, self._check_cob_id)

    def reset(self, t_ns: int) -> None:
        """No error, nothing waiting; the history survives (it is non-volatile where a device can keep it)."""
        self._active.clear()
        self._waiting.clear()
        self._timer.cancel()
        self._show()

    @property
    def active(self) -> frozenset[int]:
        """Codes of the errors present."""
        return frozenset(self._active)

    def report(self, code: int, data: bytes = b"", source: Hashable = None) -> None:
        """An error is present: remember and send it, once until it is cleared.

        Args:
            code: emergency error code.
            data: manufacturer's bytes, up to five.
            source: which of several PDOs, producers… has it; the error lasts until the last one is cleared.
        """
        if (sources := self._active.get(code)) is not None:
            sources.add(source)
            return
        self._active[code] = {source}
        self._history.insert(0, code | int.from_bytes(data[:2], "little") << 16)
        self._show()
        self._send(code, data)

    def clear(self, code: int, source: Hashable = None) -> None:
        """An error of one source is gone: EMCY 0000h with what remains in the register, if it was the last source."""
        sources = self._active.get(code)
        if sources is None:
            return
        sources.discard(source)
        if sources:
            return
        del self._active[code]
        self._show()
        if self._waiting and self._waiting[-1][0] == code:
            self._waiting.pop()  # come and gone within the inhibit time: nobody needs to hear of it
        else:
            self._send(NO_ERROR, b"")

    def _send(self, code: int, data: bytes) -> None:
        if self._core.state not in _SENDING:
            return
        self._waiting.append((code, self._register(), data))
        if self._timer.due_ns is None:
            self._inhibit_over(self._core.now_ns)

    def _inhibit_over(self, due_ns: int) -> None:
        if self._waiting:
            cob_id = self._core.dictionary.number(0x1014, 0, 0x80 + self._core.node_id)
            emcy = Emcy(*self._waiting.popleft())
            if not cob_id & INVALID:
                self._core.send(cob_id & 0x7FF, emcy.pack())
            if inhibit := self._core.dictionary.number(0x1015):
                self._timer.arm(due_ns + inhibit * 100_000)

    def _register(self) -> int:
        bits = _GENERIC if self._active else 0
        for code in self._active:
            bits |= register_bit(code)
        return bits

    def _show(self) -> None:
        dictionary = self._core.dictionary
        self.any = bool(self._active)
        dictionary.put(0x1001, 0, self._register())
        del self._history[self._room :]
        dictionary.put(0x1003, 0, len(self._history))

    def _check_read(self, subindex: int) -> None:
        """Refuse an entry that is not there; bring one that is up to date, which is only needed now."""
        if 0 < subindex <= len(self._history):
            self._core.dictionary.put(0x1003, subindex, self._history[subindex - 1])
        if subindex > len(self._history):
            raise SdoAbort(Abort.NO_DATA)

    def _cleared(self, subindex: int, value: Value) -> None:
        self._history.clear()
        self._show()

    def _check_history(self, subindex: int, value: Value) -> None:
        if subindex == 0 and value != 0:
            raise SdoAbort(Abort.VALUE)

    def _check_cob_id(self, subindex: int, value: Value) -> None:
        check_cob_id(value, self._core.dictionary.number(0x1014), reserved=0x7FFFF800)


# Heartbeat producer and consumer.


class HeartbeatProducer(Service):
    """Reports the NMT state every 1017h milliseconds, and at once when it changes or 1017h is written."""

    def __init__(self, core: NodeCore) -> None:
        self._core = core
        self._timer = core.timers.new(self._due)
        core.dictionary.on_write(0x1017, lambda _sub, _value: self._begin(core.now_ns))

    def reset(self, t_ns: int) -> None:
        """Silent until `boot_up`."""
        self._timer.cancel()

    def entered(self, t_ns: int) -> None:
        """A heartbeat with the new state."""
        self._begin(t_ns)

    def boot_up(self, t_ns: int) -> None:
        """Send the boot-up message, which is the first heartbeat."""
        self._core.send(*pack_heartbeat(self._core.node_id, NmtState.INITIALISING))
        if self._period_ns():
            self._timer.arm(t_ns + self._period_ns())

    def _period_ns(self) -> int:
        return self._core.dictionary.number(0x1017) * 1_000_000

    def _begin(self, t_ns: int) -> None:
        self._timer.cancel()
        if self._period_ns():
            self._due(t_ns)

    def _due(self, due_ns: int) -> None:
        self._core.send(*pack_heartbeat(self._core.node_id, self._core.state))
        self._timer.arm_next(due_ns, self._period_ns())


class HeartbeatConsumer(Service):
    """Watches the producers of 1016h, each from its first heartbeat on."""

    def __init__(self, core: NodeCore, emcy: Emergency, on_loss: Callable[[int], None]) -> None:
        """`on_loss(t_ns)` is called when a producer is lost."""
        self._core, self._emcy, self._on_loss = core, emcy, on_loss
        self._watched: dict[int, tuple[Timer, int]] = {}  # by node id: its timer, its period in ns
        core.dictionary.on_check(0x1016, self._check)
        core.dictionary.on_change(self._configure, 0x1016)

    def reset(self, t_ns: int) -> None:
        """Read 1016h; nobody has been heard."""
        self._configure()

    def routes(self) -> Mapping[int, Route]:
        """Heartbeat identifiers of the producers watched."""
        if self._core.state is NmtState.INITIALISING:
            return NO_ROUTES
        return {HEARTBEAT_BASE + node_id: partial(self._heard, node_id) for node_id in self._watched}

    def _entries(self) -> dict[int, tuple[int, int]]:
        """Subindex → (node id, period in ms) of the entries in use."""
        number, found = self._core.dictionary.number, {}
        for subindex in range(1, 128):
            word = number(0x1016, subindex)
            if 1 <= word >> 16 & 0xFF <= 127 and word & 0xFFFF:
                found[subindex] = word >> 16 & 0xFF, word & 0xFFFF
        return found

    def _configure(self) -> None:
        for node_id, (timer, _) in self._watched.items():
            timer.cancel()
            self._emcy.clear(HEARTBEAT_LOST, node_id)
        self._watched = {
            node_id: (self._core.timers.new(partial(self._timed_out, node_id)), period * 1_000_000)
            for node_id, period in self._entries().values()
        }
        self._core.reroute()

    def _heard(self, node_id: int, data: bytes, t_ns: int) -> None:
        if len(data) == 1:
            timer, period_ns = self._watched[node_id]
            timer.arm(t_ns + period_ns)
            if self._emcy.any:
                self._emcy.clear(HEARTBEAT_LOST, node_id)

    def _timed_out(self, node_id: int, due_ns: int) -> None:
        self._emcy.report(HEARTBEAT_LOST, bytes((node_id,)), source=node_id)
        self._on_loss(due_ns)

    def _check(self, subindex: int, value: Value) -> None:
        node_id, period = int(value) >> 16 & 0xFF, int(value) & 0xFFFF
        if subindex == 0 or not (node_id and period):
            return
        others = {node for sub, (node, _) in self._entries().items() if sub != subindex}
        if node_id in others or node_id > 127:
            raise SdoAbort(Abort.PARAMETER_INCOMPATIBLE)


# Node guarding and life guarding.
#
# Source: CiA 301, "Node guarding protocol", "Life guarding", objects 100Ch and 100Dh; error 8130h.

_MASTER = 0  # whoever guards this node: the protocol does not carry its id
_TOGGLE = 0x80


class NodeGuarding(Service):
    """Answers remote requests with toggle bit and state, and watches them from the first on, while 1017h is 0."""

    def __init__(self, core: NodeCore, emcy: Emergency, on_loss: Callable[[int], None]) -> None:
        """`on_loss(t_ns)` is called when the life guarding error occurs."""
        self._core, self._emcy, self._on_loss = core, emcy, on_loss
        self._timer = core.timers.new(self._timed_out)
        self._toggle = self._life_ns = 0
        self._heartbeat = False
        core.dictionary.on_change(self._configure, 0x100C, 0x100D, 0x1017)

    def reset(self, t_ns: int) -> None:
        """The first answer after a boot-up has the toggle bit 0."""
        self._toggle = 0
        self._configure()

    def routes(self) -> Mapping[int, Route]:
        """The remote request for this node's error control identifier."""
        if self._core.state is NmtState.INITIALISING:
            return NO_ROUTES
        return {HEARTBEAT_BASE + self._core.node_id | RTR_FLAG: self._guarded}

    def _configure(self) -> None:
        number = self._core.dictionary.number
        self._heartbeat = bool(number(0x1017))
        self._life_ns = number(0x100C) * number(0x100D) * 1_000_000
        self._timer.cancel()
        self._emcy.clear(HEARTBEAT_LOST, _MASTER)

    def _guarded(self, data: bytes, t_ns: int) -> None:
        if self._heartbeat:
            return
        self._core.send(HEARTBEAT_BASE + self._core.node_id, bytes((self._toggle | self._core.state,)))
        self._toggle ^= _TOGGLE
        if self._life_ns:
            self._timer.arm(t_ns + self._life_ns)
            self._emcy.clear(HEARTBEAT_LOST, _MASTER)

    def _timed_out(self, due_ns: int) -> None:
        self._emcy.report(HEARTBEAT_LOST, bytes((_MASTER,)), source=_MASTER)
        self._on_loss(due_ns)
