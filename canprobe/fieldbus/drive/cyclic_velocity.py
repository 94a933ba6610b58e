"""Cyclic synchronous velocity: 60FFh + 60B1h is the velocity from one SYNC to the next.

The velocity is cut to 607Fh and 6080h and the motor waits at a software limit; both set bit 11. The reference is
the integral of the velocity: the plant follows it as it follows positions.
Source: CiA 402-2, "Cyclic synchronous velocity mode", objects 60FFh, 60B1h, 60B2h, 607Dh, 607Fh, 6080h.
"""

from __future__ import annotations

from canprobe.fieldbus.drive.mode import CyclicMode
from canprobe.fieldbus.drive.profile import uniform
from canprobe.fieldbus.node.entry import key_of
from canprobe.fieldbus.protocol.cia402 import OperationMode

_VELOCITY_TARGET_KEY, _VELOCITY_OFFSET_KEY = key_of(0x60FF), key_of(0x60B1)


class CyclicVelocity(CyclicMode):
    """Mode 9."""

    number = OperationMode.CYCLIC_SYNC_VELOCITY
    target = 0x60FF
    needs = (key_of(target),)

    def latch(self, t_ns: int) -> None:
        """Move the reference on from where it is, with the new velocity."""
        values, parameters = self._values, self._parameters
        target, offset = int(values[_VELOCITY_TARGET_KEY]), int(values.get(_VELOCITY_OFFSET_KEY, 0))
        wanted = (target + offset) * self._units.speed_scale
        velocity = min(max(wanted, -parameters.max_speed), parameters.max_speed)
        self.parts.loop.feed_torque()
        here, (low, high) = self._motion.demand(t_ns), parameters.fence
        self._motion.follow(uniform(here, velocity).fenced(low, high), t_ns)
        fenced = (here >= high and velocity > 0.0) or (here <= low and velocity < 0.0)
        self._limit(velocity != wanted or fenced or self._strains())
