"""A move round a ball that never comes nearer to it than its ends do."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.tasks.probe_motion import smooth_step
from canprobe.touch.servo import ProbePose

Vector = NDArray[np.float64]


class ArcMotion:
    """Round a centre: direction along a great circle, distance and pole by a quintic time law.

    Args:
        centre: of the ball (3,), m.
        start: pose to leave, not at the centre.
        end: pose to reach; not opposite to the first.
        speed: mean speed, m/s.
        angular_speed: mean angular speed of the pole, rad/s.
    """

    def __init__(
        self, centre: Vector, start: ProbePose, end: ProbePose, speed: float, angular_speed: float = 0.7
    ) -> None:
        self._centre, self._poles = centre, (start.pole, end.pole)
        a, b = start.centre - centre, end.centre - centre
        self._radii = float(np.linalg.norm(a)), float(np.linalg.norm(b))
        self._a, self._b = a / self._radii[0], b / self._radii[1]
        self._angle = math.acos(max(-1.0, min(1.0, float(self._a @ self._b))))
        pole_angle = math.acos(max(-1.0, min(1.0, float(start.pole @ end.pole))))
        way = math.hypot(self._angle * max(self._radii), self._radii[1] - self._radii[0])
        self.duration = max(way / speed, pole_angle / angular_speed, 0.05)

    def at(self, t: float) -> ProbePose:
        """Pose ``t`` seconds after the start; the end pose afterwards."""
        s = smooth_step(t / self.duration)
        if self._angle > 1e-6:
            direction = math.sin((1 - s) * self._angle) * self._a + math.sin(s * self._angle) * self._b
            direction = direction / math.sin(self._angle)
        else:
            direction = self._b
        radius = self._radii[0] + s * (self._radii[1] - self._radii[0])
        pole = self._poles[0] + s * (self._poles[1] - self._poles[0])
        return ProbePose(self._centre + radius * direction, pole / math.sqrt(float(pole @ pole)))
