"""Coordinates of a flange: there and back, and at the poses that they name."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from canprobe.mechanics.robot.chain import forward, forward_jacobian
from canprobe.mechanics.robot.flange import flange_joints, flange_model, flange_pose

REACH, SPEED = np.array([0.3] * 3 + [1.2] * 3), np.array([0.25] * 3 + [1.0] * 3)


def pose(rotation, position):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.as_matrix(), position
    return T


@pytest.fixture(scope="module")
def model():
    mount = pose(Rotation.from_euler("xyz", (0.3, -0.2, 1.0)), (0.1, -0.5, 0.8))
    home = Rotation.from_euler("x", math.pi).as_matrix()
    return flange_model("arm", mount, home, (0.4, 0.1, 0.5), REACH, SPEED)


def test_coordinates_are_position_and_yaw_pitch_roll_in_the_base_of_the_arm(model):
    rng = np.random.default_rng(3)
    mount = pose(Rotation.from_euler("xyz", (0.3, -0.2, 1.0)), (0.1, -0.5, 0.8))
    for q in rng.uniform(model.q_min, model.q_max, (50, 6)):
        x, y, z, yaw, pitch, roll = q
        T = pose(Rotation.from_euler("ZYX", (yaw, pitch, roll)) * Rotation.from_euler("x", math.pi), (x, y, z))
        np.testing.assert_allclose(flange_pose(model, q), T, atol=1e-12)
        np.testing.assert_allclose(forward(model.chain, q), mount @ T, atol=1e-12)
        np.testing.assert_allclose(flange_joints(model, T), q, atol=1e-12)


def test_no_pose_within_the_reach_is_singular(model):
    for pitch in np.linspace(model.q_min[4], model.q_max[4], 9):
        J = forward_jacobian(model.chain, np.array([0.4, 0.1, 0.5, 0.2, pitch, -0.4]), np.eye(4))[1]
        assert np.linalg.svd(J, compute_uv=False)[-1] > 0.2
