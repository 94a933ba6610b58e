"""An object on a carrier, such as a turntable or a conveyor: where it is, by the position of the carrier, and in time.

The carrier's frame is the base frame as long as the position is 0; what stands on the carrier stands still in it.
Contacts in that frame, from `T_carrier_probe = T_base_carrier⁻¹ T_base_probe`, have the relative velocities of robot
and object in (16)–(19) of Chen, Rink and Zhang: estimators, map and servo need no term for the object's motion.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from canprobe.mechanics.touch.tangent_frames import homogeneous
from canprobe.mechanics.types import Floats

TIMES_KEPT = 64
"""Positions that are kept: as many cycles as joints are."""
SPEED_STEPS = 16
"""Steps between positions over which the speed is taken: 40 ms at 400 Hz, so that a count has little weight."""


@dataclass(frozen=True, slots=True, eq=False)
class CarrierMotion:
    """Motion of a carrier: about one axis, or along it.

    Attributes:
        axis: (3,) unit vector of the axis in base.
        point: (3,) point of the axis that it turns about, m; None: it slides along the axis.
    """

    axis: Floats
    point: Floats | None

    def T_base_carrier(self, position: float) -> Floats:
        """The carrier's frame (4, 4) in base at a position, rad or m."""
        if self.point is None:
            return homogeneous(np.eye(3), position * self.axis)
        across = np.cross(np.eye(3), self.axis)  # axis × v
        R = np.eye(3) + np.sin(position) * across + (1.0 - np.cos(position)) * (across @ across)
        return homogeneous(R, self.point - R @ self.point)

    def twist(self, speed: float) -> Floats:
        """Angular velocity, rad/s, and velocity of the carrier's point at the base's origin, m/s, (6,), at a speed."""
        if self.point is None:
            return np.concatenate((np.zeros(3), speed * self.axis))
        return speed * np.concatenate((self.axis, np.cross(self.point, self.axis)))


class CarrierTrack:
    """Where a carrier is in time, by its reported positions: linear between them, and on at its last speed.

    Args:
        motion: motion of the carrier.
    """

    def __init__(self, motion: CarrierMotion) -> None:
        self._motion = motion
        self._seen: deque[tuple[int, float]] = deque(maxlen=TIMES_KEPT)

    @property
    def is_known(self) -> bool:
        """Whether it has a position yet."""
        return bool(self._seen)

    def add(self, t_ns: int, position: float) -> None:
        """Take a position, rad or m, at ``t_ns``; times must increase."""
        self._seen.append((t_ns, position))

    def T_base_carrier(self, t_ns: int) -> Floats:
        """The carrier's frame (4, 4) in base at a time, also after the last position; there must be one."""
        times, positions = np.array(self._seen).T
        position = float(np.interp(t_ns, times, positions))
        first = max(-SPEED_STEPS, -len(times))
        if (ahead := t_ns - times[-1]) > 0 and len(times) > 1:
            position += ahead * (positions[-1] - positions[first]) / (times[-1] - times[first])
        return self._motion.T_base_carrier(position)
