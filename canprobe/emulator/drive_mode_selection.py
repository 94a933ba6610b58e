"""Which mode of operation is active, and when it sees the controlword.

The state machine obeys a controlword at once. The bits of the mode wait until all values of the same PDO are stored,
so that a set-point's target and its bit 4 belong together whatever their order in the mapping.
Source: CiA 402-2, objects 6060h, 6061h, 6502h; controlword 6040h.
"""

from __future__ import annotations

from collections.abc import Callable

from canprobe.emulator.aborts import Abort, SdoAbort
from canprobe.emulator.drive_mode import DriveParts
from canprobe.emulator.drive_modes import make_modes, supported_bits
from canprobe.emulator.entries import Value


class ModeSelection:
    """The modes of a drive, one of them active.

    Attributes:
        active: the present mode; it works in operation enabled.
        word: the last controlword.
        word_waits: the active mode has not seen it yet.
        since_ns: when the mode took over.
    """

    def __init__(self, parts: DriveParts, enabled: Callable[[], bool]) -> None:
        """`enabled()` tells whether operation is."""
        self._parts, self._enabled = parts, enabled
        self._modes = make_modes(parts)
        self.active = self._modes[0]
        self.word = self.since_ns = 0
        self.word_waits = False
        self._core = parts.node.core
        self._timer = self._core.timers.new(self.take_word)
        dictionary = parts.node.dictionary
        dictionary.on_check(0x6060, self._check)
        dictionary.on_write(0x6060, lambda _sub, value: self._select(int(value)))
        dictionary.on_read(0x6041, lambda _sub: self.take_word(self._core.now_ns))

    def reset(self) -> None:
        """Power on."""
        self.word, self.word_waits = 0, False
        for mode in self._modes.values():
            mode.reset()
        dictionary = self._parts.node.dictionary
        dictionary.put(0x6502, 0, supported_bits(self._modes))
        self._show(dictionary.number(0x6060))

    def start(self, t_ns: int) -> None:
        """The active mode takes over: operation is enabled, or the mode is new."""
        self.since_ns = t_ns
        self._parts.supervision.start(self.active.target, t_ns)
        self.active.start(self.word, t_ns)

    def keep_word(self, word: int) -> None:
        """A new controlword, before the state machine gets it."""
        self.take_word(self._core.now_ns)
        self.word = word

    def let_word_wait(self) -> None:
        """The new controlword left operation enabled; the mode sees it soon, at the same time."""
        self.word_waits = True
        self._timer.arm(self._core.now_ns)

    def take_word(self, t_ns: int) -> None:
        """Let the active mode see the controlword that waits, if one does."""
        waits, self.word_waits = self.word_waits, False
        self._timer.cancel()
        if waits and self._enabled():
            self.active.command(self.word, t_ns)

    def _select(self, mode: int) -> None:
        changes = self._modes[mode] is not self.active
        if changes and self._enabled():
            t_ns = self._core.now_ns
            self.active.leave(t_ns)
            self._parts.motion.decelerate(t_ns, self._parts.parameters.deceleration)
            self.active = self._modes[mode]
            self.start(t_ns)
        self._show(mode)

    def _show(self, mode: int) -> None:
        shown = mode if mode in self._modes else 0
        self.active = self._modes[shown]
        self._parts.node.dictionary.put(0x6061, 0, shown)
        self._parts.show()

    def _check(self, subindex: int, value: Value) -> None:
        if value not in self._modes:
            raise SdoAbort(Abort.VALUE)
