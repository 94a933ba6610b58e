"""Profile position: set-points by handshake, one under way and one waiting, each a trapezoidal move.

A rising edge of controlword bit 4 offers a set-point (607Ah with 6081h, 6083h and 6084h of that moment); bit 5 puts
it in place of everything else at once, bit 6 makes it relative to the set-point before. Statusword bit 12 is set when
it was taken, and stays set while bit 4 is or while no other one can be taken; one that is offered then is ignored.
The next set-point starts when the last is reached (bit 10): the actual position has been within 6067h for 6068h, or,
where 6067h is FFFFFFFFh and so switched off, the move has ended.
Bit 9 (change on set-point) and 60F2h are not supported. Halt interrupts a move, which goes on when halt is over.
Source: CiA 402-2, "Profile position mode", objects 6067h, 6068h, 607Ah, 607Dh, 607Fh, 6081h, 6083h, 6084h, 6086h.
"""

from __future__ import annotations

from math import inf
from typing import NamedTuple

from canprobe.fieldbus.drive.cyclic_modes import POSITION_TARGET_KEY
from canprobe.fieldbus.drive.mode import REACHED_FLAG, ProfiledMode
from canprobe.fieldbus.drive.parts import DriveParts
from canprobe.fieldbus.drive.profile import Rates
from canprobe.fieldbus.drive.reference import STEP_NS
from canprobe.fieldbus.node.dictionary import key_of
from canprobe.fieldbus.protocol import cia402

_PROFILE_SPEED_KEY = key_of(0x6081)


class SetPoint(NamedTuple):
    """One move.

    Attributes:
        counts: target within the software limits, motor counts.
        rates: rates of the move; with a speed of 0 the drive stands still.
        limited: whether the target of the master was beyond the limits.
    """

    counts: float
    rates: Rates
    limited: bool


class ProfilePosition(ProfiledMode):
    """Mode 1."""

    number = cia402.OperationMode.PROFILE_POSITION
    needs = (key_of(0x607A), key_of(0x6081))

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._active: SetPoint | None = None
        self._next: SetPoint | None = None
        self._last = 0
        self._inside_ns: int | None = None
        self._reached = self._offered = False

    def start(self, word: int, t_ns: int) -> None:
        """Start without a set-point; relative ones begin from the present position."""
        self._active = self._next = self._inside_ns = None
        self._offered = self._reached = False
        self._last = round(self._units.position(self._motion.demand(t_ns)))
        super().start(word, t_ns)
        self._timer.arm(t_ns + STEP_NS)

    def status(self) -> int:
        """Bits for target reached, with halt for standstill, and for set-point acknowledge."""
        acknowledged = self._offered or self._next is not None
        reached = super().status() if self.halted else REACHED_FLAG * self._reached
        return reached | acknowledged << cia402.SETPOINT_ACKNOWLEDGE_BIT

    def bits(self, word: int, changed: int, t_ns: int) -> None:
        """Take a set-point that is offered, or the end of the offer."""
        offers = word >> cia402.NEW_SETPOINT_BIT & 1
        if not offers:
            self._offered = False
        elif changed >> cia402.NEW_SETPOINT_BIT & 1:
            at_once = bool(word >> cia402.CHANGE_IMMEDIATELY_BIT & 1)
            if at_once or self._next is None:
                self._offered = True
                point = self._set_point(relative=bool(word >> cia402.RELATIVE_BIT & 1))
                if at_once or self._active is None or self._reached:
                    self._next = None
                    self._begin(point, t_ns)
                else:
                    self._next = point

    def resume(self, t_ns: int) -> None:
        """Go on with the interrupted move."""
        if self._active is not None and not self._reached:
            self._move(self._active, t_ns)

    def _set_point(self, relative: bool) -> SetPoint:
        parameters, units = self._parameters, self._units
        wanted = int(self._values[POSITION_TARGET_KEY]) + (self._last if relative else 0)
        target = self._last = parameters.clamp(wanted)
        speed = min(int(self._values.get(_PROFILE_SPEED_KEY, 0)) * units.speed, parameters.max_speed)
        rates = Rates(speed, parameters.acceleration, parameters.deceleration or parameters.acceleration)
        return SetPoint(units.counts(target), rates, limited=target != wanted)

    def _begin(self, point: SetPoint, t_ns: int) -> None:
        self._active, self._inside_ns, self._reached = point, None, False
        self._limit(point.limited)
        if not self.halted:
            self._move(point, t_ns)
        self.parts.show()

    def _move(self, point: SetPoint, t_ns: int) -> None:
        if point.rates.speed:
            self._motion.move(point.counts, t_ns, point.rates)
        else:
            self._motion.decelerate(t_ns, point.rates.deceleration)

    def watch(self, t_ns: int, counts: float) -> None:
        """Check whether the set-point is reached."""
        point = self._active
        if point is not None and not self._reached and not self.halted:
            window = self._parameters.position_window
            if window == inf:
                window, counts = 0.5, self._motion.demand(t_ns)
            if abs(point.counts - counts) > window:
                self._inside_ns = None
            elif self._inside_ns is None:
                self._inside_ns = t_ns
            if self._inside_ns is not None and t_ns - self._inside_ns >= self._parameters.position_time_ns:
                self._reached = True
                following, self._next = self._next, None
                if following is not None:
                    self._begin(following, t_ns)
                self.parts.show()
        self._limit((point is not None and point.limited) or self._strains())
