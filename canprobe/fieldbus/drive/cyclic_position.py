"""Cyclic synchronous position: the motor reaches a target latched at a SYNC by a straight ramp after 60C2h."""

from __future__ import annotations

from canprobe.fieldbus.drive.mode import CyclicMode, DriveParts
from canprobe.fieldbus.drive.parameters import PEAK_TORQUE_PERMILLE
from canprobe.fieldbus.node.entry import key_of
from canprobe.fieldbus.protocol.cia402 import OperationMode
from canprobe.fieldbus.protocol.emcy import REFERENCE_LIMIT_CODE

MAX_ROUNDING_COUNTS = 2
POSITION_TARGET_KEY = key_of(0x607A)
_POSITION_OFFSET_KEY = key_of(0x60B0)


class CyclicPosition(CyclicMode):
    """Mode 8. A missing target does not begin the ramp under way again.

    Attributes:
        wanted: dictionary keys of the two values whose sum is the target, position units.
    """

    number = OperationMode.CYCLIC_SYNC_POSITION
    target = 0x607A
    needs = (key_of(target),)
    repeats, lags = False, True
    wanted = POSITION_TARGET_KEY, _POSITION_OFFSET_KEY

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._latched_ns = 0

    def start(self, word: int, t_ns: int) -> None:
        """Start; the first target may be as far away as the time from now on allows."""
        self._latched_ns = t_ns
        super().start(word, t_ns)

    def latch(self, t_ns: int) -> None:
        """Follow the target from the one before it."""
        parameters, units, motion, values = self._parameters, self._units, self._motion, self._values
        key, offset = self.wanted
        target: int = values[key] + values.get(offset, 0)  # type: ignore[assignment, operator]  # they are whole numbers
        low, high = parameters.low, parameters.high
        allowed = target if low <= target <= high else parameters.clamp(target)
        counts, onset = allowed * units.scale + units.origin, motion.onset(t_ns)
        reach_ns, passed_ns = parameters.interpolation_ns, t_ns - self._latched_ns
        passed_ns = passed_ns if passed_ns > reach_ns else reach_ns
        if abs(counts - onset) > parameters.max_speed * passed_ns * 1e-9 + MAX_ROUNDING_COUNTS:
            self.parts.fault(REFERENCE_LIMIT_CODE, t_ns)
            return
        self._latched_ns = t_ns
        if self.parts.loop.changed:
            self.parts.loop.feed_forward()
        motion.reach(onset, counts, t_ns, t_ns + reach_ns)
        limited = allowed != target or (parameters.max_torque < PEAK_TORQUE_PERMILLE and self._strains())
        if limited is not self.limited:
            self._limit(limited)
