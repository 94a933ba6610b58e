"""EMCY producer, error register 1001h and error history 1003h.

Source: CiA 301, "Emergency object", objects 1001h, 1003h, 1014h, 1015h.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable

from canprobe.fieldbus.node.core import TALKING_STATES, NodeCore, Service, check_cob_id
from canprobe.fieldbus.node.dictionary import Value
from canprobe.fieldbus.protocol.emcy import NO_ERROR_CODE, Emcy
from canprobe.fieldbus.protocol.frames import INVALID_FLAG
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

_GENERIC_FLAG = 0x01
# Bits of 1001h by the first nibble of the code: current, voltage, temperature, communication/profile, manufacturer.
_REGISTER_BITS = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x7: 0x80, 0xF: 0x80}


def register_bit(code: int) -> int:
    """The bit of the error register 1001h that an emergency error code sets beside the generic one."""
    if code & 0xF000 == 0x8000:
        return 0x10 if code & 0x0F00 <= 0x0200 else 0x20
    return _REGISTER_BITS.get(code >> 12, 0)


_MAX_WAITING_MESSAGES = 16
"""Most messages that wait while the inhibit time runs; beyond it the oldest are dropped."""


class Emergency(Service):
    """Reports each error once when it comes and once when it is gone, and keeps the history.

    Attributes:
        any: whether any error is present.
    """

    def __init__(self, core: NodeCore) -> None:
        self._core = core
        self._active: dict[int, set[Hashable]] = {}
        self.any = False
        self._history: list[int] = []
        self._waiting: deque[tuple[int, int, bytes]] = deque(maxlen=_MAX_WAITING_MESSAGES)
        self._room = sum(1 for key in core.dictionary.entries if key >> 8 == 0x1003 and key & 0xFF)
        self._timer = core.timers.new(self._inhibit_over)
        core.dictionary.on_check(0x1003, self._check_history)
        core.dictionary.on_write(0x1003, self._cleared)
        core.dictionary.on_read(0x1003, self._check_read)
        core.dictionary.on_check(0x1014, self._check_cob_id)

    def reset(self, t_ns: int) -> None:
        """Forget the errors and what waits; the history stays, as in the non-volatile memory of a device."""
        self._active.clear()
        self._waiting.clear()
        self._timer.cancel()
        self._show()

    @property
    def active(self) -> frozenset[int]:
        """Codes of the errors that are present."""
        return frozenset(self._active)

    def report(self, code: int, data: bytes = b"", source: Hashable = None) -> None:
        """Report that an error is present: it is kept and sent, once until it is cleared.

        Args:
            code: emergency error code.
            data: bytes of the manufacturer, up to five.
            source: the PDO, producer… that has the error; the error lasts until it is cleared for the last one.
        """
        if (sources := self._active.get(code)) is not None:
            sources.add(source)
            return
        self._active[code] = {source}
        self._history.insert(0, code | int.from_bytes(data[:2], "little") << 16)
        self._show()
        self._send(code, data)

    def clear(self, code: int, source: Hashable = None) -> None:
        """Report that an error of one source is gone; with the last source EMCY 0000h is sent."""
        sources = self._active.get(code)
        if sources is None:
            return
        sources.discard(source)
        if sources:
            return
        del self._active[code]
        self._show()
        if self._waiting and self._waiting[-1][0] == code:
            self._waiting.pop()  # it came and went within the inhibit time: no message is needed
        else:
            self._send(NO_ERROR_CODE, b"")

    def _send(self, code: int, data: bytes) -> None:
        if self._core.state not in TALKING_STATES:
            return
        self._waiting.append((code, self._register(), data))
        if self._timer.due_ns is None:
            self._inhibit_over(self._core.now_ns)

    def _inhibit_over(self, due_ns: int) -> None:
        if self._waiting:
            cob_id = self._core.dictionary.number(0x1014, 0, 0x80 + self._core.node_id)
            emcy = Emcy(*self._waiting.popleft())
            if not cob_id & INVALID_FLAG:
                self._core.send(cob_id & 0x7FF, emcy.pack())
            if inhibit := self._core.dictionary.number(0x1015):
                self._timer.arm(due_ns + inhibit * 100_000)

    def _register(self) -> int:
        bits = _GENERIC_FLAG if self._active else 0
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
        """Refuse an entry that is not there; bring one that is there up to date, which only a reader needs."""
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
        # with bit 30, which is "no RTR" in a TPDO and reserved here
        check_cob_id(value, self._core.dictionary.number(0x1014), reserved=0x7FFFF800)
