"""Interpolated position: 60C1h:01 is the target of the next SYNC while bit 4 of the controlword is set.

Bit 4 starts the interpolation and sets statusword bit 12; without it the reference slows down by 6084h to rest. The
target at the time of bit 4 is followed even if it is old, as drives do: the master has to write the present position
first. 60C0h is linear interpolation (0) or that of a maker (below 0). There is no buffer (60C4h): the last target that
was written counts.
Source: CiA 402-2, "Interpolated position mode", objects 60C0h, 60C1h, 60C2h.
"""

from __future__ import annotations

from canprobe.fieldbus.drive.cyclic_position import CyclicPosition
from canprobe.fieldbus.drive.mode import REACHED_FLAG, DriveParts
from canprobe.fieldbus.node.abort import Abort, SdoAbort
from canprobe.fieldbus.node.entry import Value, key_of
from canprobe.fieldbus.protocol.cia402 import ENABLE_INTERPOLATION_BIT, INTERPOLATION_ACTIVE_BIT, OperationMode

_RECORD_KEY = key_of(0x60C1, 1)


class InterpolatedPosition(CyclicPosition):
    """Mode 7."""

    number = OperationMode.INTERPOLATED_POSITION
    target = 0x60C1
    needs = (_RECORD_KEY,)
    wanted = _RECORD_KEY, 0  # 0000h has no value

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._active = False
        parts.node.dictionary.on_check(0x60C0, _check_submode)

    def start(self, word: int, t_ns: int) -> None:
        """Start; the interpolation is active at once if bit 4 is already set."""
        super().start(word, t_ns)
        self._active = self._fresh = bool(word >> ENABLE_INTERPOLATION_BIT & 1)

    def status(self) -> int:
        """Bit for active interpolation; with halt, or without bit 4, that for rest."""
        return 1 << INTERPOLATION_ACTIVE_BIT if self._active and not self.halted else REACHED_FLAG * self._standstill

    def bits(self, word: int, changed: int, t_ns: int) -> None:
        """Start the interpolation with bit 4, and stop it when the bit is cleared."""
        if changed >> ENABLE_INTERPOLATION_BIT & 1:
            self._active = self._fresh = bool(word >> ENABLE_INTERPOLATION_BIT & 1)
            if self._active:
                self._latched_ns = t_ns
            elif not self.halted:
                self._standstill = False
                self._motion.decelerate(t_ns, self._parameters.deceleration, self._at_standstill)

    def latch(self, t_ns: int) -> None:
        """Follow the target, where the interpolation is active."""
        if self._active:
            super().latch(t_ns)


def _check_submode(subindex: int, value: Value) -> None:
    if int(value) > 0:
        raise SdoAbort(Abort.VALUE)
