"""The touches that a `calibrate` scene makes: of the ball that it expects, in SI units and the base frame."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.robot.tool_calibration import BallApproach, ball_approaches
from canprobe.scene import TaskSettings
from canprobe.scene_geometry import approach_normal

Array = NDArray[np.float64]


def expected_ball(task: TaskSettings) -> tuple[Array, float]:
    """Centre (3,), m, base frame, and radius, m, of the ball: its top is at `start_mm`."""
    radius = task.ball_radius_mm * 1e-3
    return np.array(task.start_mm) * 1e-3 - radius * approach_normal(task), radius


def planned_approaches(task: TaskSettings) -> list[BallApproach]:
    """The touches in their order."""
    return ball_approaches(
        task.touches, math.radians(task.tilt_deg), math.radians(task.beside_deg), approach_normal(task)
    )
