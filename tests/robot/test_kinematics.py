"""The arm's numbers: geometry, counts per turn, wrist coupling, ranges."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canprobe.robot.kinematics import (
    ELBOW_FORM,
    MODELS,
    UPENN,
    PumaModel,
    chain,
    count_sigma,
    counts_to_joints,
    forward,
    forward_jacobian,
    joints_to_counts,
    point_velocity,
    tool_z_offset,
)

ANGLES = st.lists(st.floats(-7, 7), min_size=6, max_size=6)


@pytest.mark.parametrize(("joint", "counts_per_turn"), list(enumerate((46720, 69973, 42987, 34809, 31508, 25415))))
def test_counts_per_joint_turn_are_the_published_ones(joint, counts_per_turn):
    q = np.zeros(6)
    q[joint] = 2 * math.pi
    assert joints_to_counts(UPENN, q)[joint] == pytest.approx(counts_per_turn, abs=0.51)


def test_wrist_coupling_signs_and_sizes():
    turn_j4, turn_j5 = np.zeros(6), np.zeros(6)
    turn_j4[3] = turn_j5[4] = 2 * math.pi
    assert joints_to_counts(UPENN, turn_j4)[4] == pytest.approx(-9.8462 * 800)
    assert joints_to_counts(UPENN, turn_j4)[5] == pytest.approx(1.0 * 800)
    assert joints_to_counts(UPENN, turn_j5)[5] == pytest.approx(-5.6 * 800)
    assert joints_to_counts(UPENN, turn_j5)[3] == 0.0
    assert not np.any(np.triu(UPENN.counts, 1)), "a motor never depends on a joint beyond it"


@given(ANGLES)
def test_counts_round_trip(q):
    assert counts_to_joints(UPENN, joints_to_counts(UPENN, q)) == pytest.approx(q, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "lengths_mm"),
    [("upenn", (330.2, 203.2, -127.0, 0.0, 203.2, 63.5)), ("unimate", (330.2, 198.1, -124.5, -19.05, 203.2, 55.9))],
)
def test_published_lengths(name, lengths_mm):
    # base height, upper arm, shoulder offset, elbow offset, forearm, flange
    assert np.array(MODELS[name].links) * 1e3 == pytest.approx(lengths_mm, abs=0.05)


def test_models_are_read_only_and_name_themselves():
    for name, model in MODELS.items():
        assert model.name == name
        for array in (model.dh, model.q_min, model.q_max, model.qd_max, model.counts):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1.0


@pytest.mark.parametrize(("row", "column"), [(0, 0), (3, 0), (4, 2), (1, 1)])
def test_a_geometry_outside_the_puma_pattern_is_refused(row, column):
    dh = UPENN.dh.copy()
    dh[row, column] += 0.01
    with pytest.raises(ValueError, match="PUMA pattern"):
        PumaModel("bent", dh, UPENN.q_min, UPENN.q_max, UPENN.qd_max, UPENN.counts)


# Forward kinematics against the product of DH matrices, Jacobian against central differences.

BOTH = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
SOME_ANGLES = st.lists(st.floats(-math.pi, math.pi), min_size=6, max_size=6)
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
@given(q=SOME_ANGLES)
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
@given(q=SOME_ANGLES)
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
@given(q=SOME_ANGLES, qd=st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_point_velocity_is_the_jacobian_times_the_rates(model, q, qd):
    T, J = forward_jacobian(model, q, TILTED_TOOL)
    velocity = point_velocity(chain(model, q), tuple(T[:3, 3]), qd)
    assert velocity == pytest.approx(J[:3] @ qd, abs=1e-13)


# What the encoders' counts leave open of the tool's position, against rounding at random.


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.6, 0.0, -0.8)])
@pytest.mark.parametrize("name", sorted(MODELS))
def test_it_is_the_scatter_of_a_tool_whose_joints_are_rounded(name, direction):
    model = MODELS[name]
    tool = np.eye(4)
    tool[:3, 3] = 0.01, -0.02, 0.08
    rng = np.random.default_rng(4)
    middle = np.array([1.6, 1.1, 0.2, 0.1, 1.8, 0.1])
    errors = []
    for _ in range(2000):
        q = middle + rng.uniform(-0.01, 0.01, 6)
        seen = counts_to_joints(model, np.round(joints_to_counts(model, q)))
        error = (forward(model, seen) @ tool)[:3, 3] - (forward(model, q) @ tool)[:3, 3]
        errors.append(error @ np.array(direction))
    assert count_sigma(model, middle, tool, direction) == pytest.approx(np.std(errors), rel=0.06)
    assert abs(np.mean(errors)) < 0.1 * np.std(errors)
