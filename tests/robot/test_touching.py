"""Start poses: the probe stands on the surface with its pole against the normal."""

import math

import numpy as np
import pytest

from canprobe.errors import PlanError
from canprobe.robot.kinematics import forward, tool_z_offset
from canprobe.robot.puma260 import ELBOW_FORM, MODELS, UPENN
from canprobe.robot.touching import probe_pose, start_posture

TOOL = tool_z_offset(80.0)
POINT = np.array((-0.120, -0.1225, 0.374))


def test_probe_pose_is_a_rotation_with_the_pole_against_the_normal():
    normal = np.array((0.1, -0.2, 1.0))
    T = probe_pose(POINT, normal, 0.0397, (1.0, 0.0, 0.0))
    n = normal / np.linalg.norm(normal)
    assert T[:3, :3] @ T[:3, :3].T == pytest.approx(np.eye(3), abs=1e-14)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert T[:3, 2] == pytest.approx(-n)
    assert (T[:3, 3] - POINT) @ n == pytest.approx(0.0397)
    assert T[:3, 0] @ np.array((1.0, 0.0, 0.0)) > 0.9


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_start_posture_of_the_default_scan_point(model):
    q = start_posture(model, POINT, (0, 0, 1), radius_m=0.040, T_flange_probe=TOOL, clearance_m=0.005)
    T = forward(model, q) @ TOOL
    assert T[:3, 3] == pytest.approx(POINT + np.array((0, 0, 0.045)), abs=1e-12)
    assert T[:3, 2] == pytest.approx((0, 0, -1), abs=1e-12)
    assert np.abs(q - ELBOW_FORM).max() < math.radians(10.0)


def test_yaw_turns_the_pad():
    q = start_posture(UPENN, POINT, (0, 0, 1), radius_m=0.04, T_flange_probe=TOOL, yaw_rad=0.3)
    assert (forward(UPENN, q) @ TOOL)[:3, 0] == pytest.approx((math.cos(0.3), math.sin(0.3), 0.0), abs=1e-12)


def test_unreachable_and_degenerate_requests_are_refused():
    with pytest.raises(PlanError, match="out of reach"):
        start_posture(UPENN, (0.9, 0, 0), (0, 0, 1), radius_m=0.04, T_flange_probe=TOOL)
    with pytest.raises(ValueError, match="parallel"):
        probe_pose(POINT, (0, 0, 1), 0.04, (0, 0, 2))
