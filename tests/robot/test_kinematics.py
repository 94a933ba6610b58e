"""Forward kinematics against the product of DH matrices, Jacobian against central differences."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canprobe.robot.kinematics import chain, forward, forward_jacobian, point_velocity, tool_z_offset
from canprobe.robot.puma260 import ELBOW_FORM, MODELS, UPENN

BOTH = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
ANGLES = st.lists(st.floats(-math.pi, math.pi), min_size=6, max_size=6)
TILTED_TOOL = np.array(
    [[0.36, 0.48, -0.8, 0.01], [-0.8, 0.6, 0.0, -0.02], [0.48, 0.64, 0.6, 0.08], [0.0, 0.0, 0.0, 1.0]]
)


def dh_product(model, q):
    """T_base_flange by multiplying Rz(theta) Tz(d) Tx(a) Rx(alpha), each a 4x4 of its own."""
    T = np.eye(4)
    for (a, alpha, d), theta in zip(model.dh, q, strict=True):
        rz, rx, shift = np.eye(4), np.eye(4), np.eye(4)
        rz[:2, :2] = [[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]]
        rx[1:3, 1:3] = [[math.cos(alpha), -math.sin(alpha)], [math.sin(alpha), math.cos(alpha)]]
        shift[0, 3], shift[2, 3] = a, d
        T = T @ rz @ shift @ rx
    return T


@BOTH
@given(q=ANGLES)
def test_forward_is_the_product_of_dh_matrices(model, q):
    assert np.abs(forward(model, q) - dh_product(model, q)).max() < 1e-14


def test_known_poses_of_the_upenn_arm():
    # All angles zero: upper arm along +x, forearm and flange up, shoulder offset toward +y. Inches.
    T = forward(UPENN, np.zeros(6))
    assert T[:3, 3] / 0.0254 == pytest.approx((8.0, 5.0, 13.0 + 8.0 + 2.5))
    assert T[:3, :3] == pytest.approx(np.eye(3))
    # Joint 1 by +90 degrees turns everything about base z.
    assert forward(UPENN, [math.pi / 2, 0, 0, 0, 0, 0])[:3, 3] / 0.0254 == pytest.approx((-5.0, 8.0, 23.5))
    # Joint 2 by +90 degrees lifts the upper arm; the forearm then points backward.
    assert forward(UPENN, [0, math.pi / 2, 0, 0, 0, 0])[:3, 3] / 0.0254 == pytest.approx((-10.5, 5.0, 21.0))


def test_elbow_form_points_down_into_the_scan_region():
    T = forward(UPENN, ELBOW_FORM) @ tool_z_offset(80.0)
    assert T[:3, 2] == pytest.approx((0, 0, -1), abs=1e-12)
    assert -0.140 <= T[0, 3] <= -0.100
    assert -0.140 <= T[1, 3] <= -0.105
    assert T[2, 3] - 0.040 == pytest.approx(0.369, abs=0.010)


@BOTH
@pytest.mark.parametrize("T_flange_tool", [np.eye(4), tool_z_offset(80.0), TILTED_TOOL], ids=["none", "z80", "tilted"])
@settings(max_examples=25)
@given(q=ANGLES)
def test_jacobian_matches_central_differences(model, T_flange_tool, q):
    q = np.array(q)
    T, J = forward_jacobian(model, q, T_flange_tool)
    assert np.abs(T - dh_product(model, q) @ T_flange_tool).max() < 1e-14
    h = 1e-6
    for i in range(6):
        step = h * np.eye(6)[i]
        plus, minus = (dh_product(model, q + s) @ T_flange_tool for s in (step, -step))
        rate = (plus - minus) / (2 * h)
        spin = rate[:3, :3] @ T[:3, :3].T
        assert J[:3, i] == pytest.approx(rate[:3, 3], abs=1e-9)
        assert J[3:, i] == pytest.approx((spin[2, 1], spin[0, 2], spin[1, 0]), abs=1e-9)


@BOTH
@given(q=ANGLES, qd=st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_point_velocity_is_the_jacobian_times_the_rates(model, q, qd):
    T, J = forward_jacobian(model, q, TILTED_TOOL)
    velocity = point_velocity(chain(model, q), tuple(T[:3, 3]), qd)
    assert velocity == pytest.approx(J[:3] @ qd, abs=1e-13)
