"""Cyclic synchronous position: a target latched at a SYNC is reached by a straight ramp after 60C2h.

A target that is further from the one before than 607Fh and 6080h let the motor go in the time between them is not
followed: reference limit, a fault. A target that was corrupted on its way is one, unless it is off by less.
Offsets of velocity and torque (60B1h, 60B2h) are feed-forwards of a dynamic plant; the ideal one needs none.
Source: CiA 402-2, "Cyclic synchronous position mode", objects 607Ah, 607Dh, 607Fh, 6080h, 60B0h–60B2h,
60C2h; error code 8612h.
"""

from __future__ import annotations

from canprobe.emulator.drive_mode import FOLLOWS, DriveMode, DriveParts
from canprobe.emulator.drive_parameters import PEAK_PERMILLE
from canprobe.emulator.entries import key_of
from canprobe.protocol.emcy import FOLLOWING_ERROR, REFERENCE_LIMIT

ROUNDING_COUNTS = 2
_TARGET, _OFFSET = key_of(0x607A), key_of(0x60B0)


class CyclicPosition(DriveMode):
    """Mode 8. It is the hot one, hence on its own beside `CyclicMode`."""

    target = 0x607A

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._loop = parts.loop
        self._fresh = False
        self._latched_ns = 0
        parts.node.dictionary.on_write(self.target, self._target_written)

    def start(self, word: int, t_ns: int) -> None:
        """A target that came before does not count."""
        self._fresh = False
        self._latched_ns = t_ns
        super().start(word, t_ns)

    def status(self) -> int:
        """The drive follows the command value, unless halted."""
        return super().status() if self.halted else FOLLOWS

    def sync(self, t_ns: int, counts: float) -> None:
        """Watch the following error and the master, latch the target received since the last SYNC."""
        demand, supervision = self._motion.demand(t_ns), self._supervision
        if supervision.following_error(demand - counts, t_ns):
            self.parts.fault(FOLLOWING_ERROR, t_ns)
            return
        fresh, self._fresh = self._fresh, False
        supervision.sync(fresh, t_ns)
        if fresh and not self.halted:
            self._latch(t_ns, demand)

    def _latch(self, t_ns: int, demand: float) -> None:
        """Follow the target from where the reference is, `demand`."""
        values, parameters, units = self._values, self._parameters, self._units
        target: int = values[_TARGET] + values.get(_OFFSET, 0)  # type: ignore[assignment, operator]
        allowed = parameters.clamp(target)
        counts = allowed * units.scale + units.origin
        passed_ns = max(parameters.interpolation_ns, t_ns - self._latched_ns)
        if abs(counts - demand) > parameters.max_speed * passed_ns * 1e-9 + ROUNDING_COUNTS:
            self.parts.fault(REFERENCE_LIMIT, t_ns)
            return
        self._latched_ns = t_ns
        if self._loop.changed:
            self._loop.feed_forward()
        self._motion.reach(counts, t_ns, parameters.interpolation_ns)
        limited = allowed != target or (parameters.max_torque < PEAK_PERMILLE and self._strains())
        if limited is not self.limited:
            self._limit(limited)

    def _target_written(self, subindex: int, value: object) -> None:
        self._fresh = True
