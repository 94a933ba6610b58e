"""Interpolated position: 60C1h:01 is the target of the next SYNC while bit 4 of the controlword is set.

With bit 4 the interpolation becomes active and statusword bit 12 set; without it the reference slows down by 6084h
and stands. The target that stands when bit 4 comes is followed even if it is an old one, as drives do: the master
has to write the present position first. 60C0h is linear interpolation (0) or what a maker calls so (below 0); there
is no buffer (60C4h): the last target written counts.
Source: CiA 402-2, "Interpolated position mode", objects 60C0h, 60C1h, 60C2h.
"""

from __future__ import annotations

from canprobe.fieldbus.drive.cyclic_position import CyclicPosition
from canprobe.fieldbus.drive.mode import REACHED_FLAG, DriveParts
from canprobe.fieldbus.node.abort import Abort, SdoAbort
from canprobe.fieldbus.node.entry import Value, key_of
from canprobe.fieldbus.protocol.cia402 import (
    ENABLE_INTERPOLATION_BIT,
    INTERPOLATION_ACTIVE_BIT,
    OperationMode,
)

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
        """Active at once where bit 4 is set already."""
        super().start(word, t_ns)
        self._active = self._fresh = bool(word >> ENABLE_INTERPOLATION_BIT & 1)

    def status(self) -> int:
        """Interpolation active; with halt, or without bit 4, at rest."""
        return 1 << INTERPOLATION_ACTIVE_BIT if self._active and not self.halted else REACHED_FLAG * self._standstill

    def bits(self, word: int, changed: int, t_ns: int) -> None:
        """Bit 4 starts the interpolation, and stops it when it is taken away."""
        if changed >> ENABLE_INTERPOLATION_BIT & 1:
            self._active = self._fresh = bool(word >> ENABLE_INTERPOLATION_BIT & 1)
            if self._active:
                self._latched_ns = t_ns
            elif not self.halted:
                self._standstill = False
                self._motion.decelerate(t_ns, self._parameters.deceleration, self._at_standstill)

    def latch(self, t_ns: int) -> None:
        """Follow the record, where the interpolation is active."""
        if self._active:
            super().latch(t_ns)


def _check_submode(subindex: int, value: Value) -> None:
    if int(value) > 0:
        raise SdoAbort(Abort.VALUE)
