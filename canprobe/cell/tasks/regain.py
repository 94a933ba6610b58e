"""Contact that a scan has lost: the probe stops along its path and goes on towards the object, slowly and not far."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.touch.servo import ProbePose

Vector = NDArray[np.float64]
SPEED = 2e-3
"""m/s: until the first sample of the new touch has taken effect, 27 ms later, the layer sinks in by 0.05 mm."""
BRAKE_S = 0.02
"""Time constant with which the motion along the path ends: 0.5 mm at 25 mm/s."""
REST_S = 0.25
"""Time at rest on the surface that was found, until the wanted force is reached and the scan goes on."""


@dataclass(slots=True)
class Loss:
    """One time that a scan lost its contact.

    Attributes:
        cycle: in which it was noticed.
        searched: how far the probe went towards the object, m.
        regained_s: time from there to the new touch; None while, or because, there is none.
    """

    cycle: int
    searched: float = 0.0
    regained_s: float | None = None


class Search:
    """The probe's motion from a lost contact to the object, along its pole.

    Args:
        pose: of the probe where the contact was lost.
        velocity: of its centre then (3,), m/s; what of it runs along the path fades out.
    """

    def __init__(self, pose: ProbePose, velocity: Vector) -> None:
        self._start = pose
        self._sideways = velocity - pose.pole * float(velocity @ pose.pole)

    def pose(self, t: float) -> ProbePose:
        """Pose ``t`` seconds after the loss."""
        sideways = self._sideways * (BRAKE_S * (1.0 - math.exp(-t / BRAKE_S)))
        return ProbePose(self._start.centre + sideways + self._start.pole * (SPEED * t), self._start.pole)
