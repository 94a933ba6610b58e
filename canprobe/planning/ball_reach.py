"""Can the arm touch a ball from all sides that a calibration wants."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import PlanError
from canprobe.robot.inverse import inverse_near
from canprobe.robot.kinematics import forward
from canprobe.robot.puma260 import PumaModel
from canprobe.robot.touching import probe_pose
from canprobe.scene import ArmSettings, ProbeSettings, Scene
from canprobe.scene_ball import expected_ball, planned_approaches
from canprobe.scene_geometry import T_flange_probe

Array = NDArray[np.float64]


def joints_on_ball(
    model: PumaModel, scene: Scene, arm: ArmSettings, probe: ProbeSettings
) -> tuple[Array | None, list[str]]:
    """Joint angles above and at each touch (2n, 6), rad, and what is out of reach."""
    to_flange, radius = np.linalg.inv(T_flange_probe(probe)), probe.radius_mm * 1e-3
    centre, ball = expected_ball(scene.task)
    q = np.radians(arm.start_deg)
    x_hint = (forward(model, q) @ T_flange_probe(probe))[:3, 0]
    found: list[Array] = []
    for number, touch in enumerate(planned_approaches(scene.task), start=1):
        for gap in (scene.task.clearance_mm * 1e-3, 0.0):
            middle = centre + (ball + radius + gap) * touch.n_base
            try:
                T = probe_pose(middle, -touch.pole_base, 0.0, x_hint)
                q = inverse_near(model, T @ to_flange, q, max_move_rad=math.inf if not found else 1.0)
            except (PlanError, ValueError) as error:
                return None, [
                    f"task: touch {number} of {scene.task.touches} is out of reach: {error}; move the ball, or lower "
                    "task.tilt_deg or task.beside_deg"
                ]
            found.append(q)
    return np.array(found), []
