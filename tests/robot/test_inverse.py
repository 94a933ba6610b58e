"""Inverse kinematics: all branches close, angles land in the ranges, refusals name the joint."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from canprobe.errors import PlanError
from canprobe.robot.inverse import (
    damped_step,
    inverse,
    inverse_near,
    lifting_step,
    probe_pose,
    singularities,
    start_posture,
)
from canprobe.robot.kinematics import (
    ELBOW_FORM,
    MODELS,
    UPENN,
    counts_to_joints,
    forward,
    forward_jacobian,
    joints_to_counts,
    tool_z_offset,
)

BOTH = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)


def dh_product(model, q):
    T = np.eye(4)
    for (a, alpha, d), theta in zip(model.dh, q, strict=True):
        ct, st_, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
        T = T @ [[ct, -st_ * ca, st_ * sa, a * ct], [st_, ct * ca, -ct * sa, a * st_], [0, sa, ca, d], [0, 0, 0, 1]]
    return T


@BOTH
def test_eight_branches_close_over_random_poses(model):
    rng = np.random.default_rng(260)
    worst = 0.0
    for _ in range(400):
        q = rng.uniform(model.q_min, model.q_max)
        T = dh_product(model, q)
        solutions = inverse(model, T, q)
        assert len({(s.shoulder, s.elbow, s.wrist) for s in solutions}) == 8
        worst = max(worst, *(np.abs(dh_product(model, s.q) - T).max() for s in solutions))
        assert min(np.abs(s.q - q).max() for s in solutions) < 1e-7, "the posture that made the pose is one of them"
        for s in solutions:
            inside = bool(np.all(s.q >= model.q_min - 1e-9) and np.all(s.q <= model.q_max + 1e-9))
            assert s.within_limits == inside
            assert s.wrist * math.sin(s.q[4]) >= -1e-12
    assert worst < 1e-11


@BOTH
@pytest.mark.parametrize(
    "q_deg",
    [
        (10, 20, -40, 30, 0.0, 50),
        (10, 20, -40, 30, 1e-7, 50),
        (10, 20, -40, 30, 180.0, 50),
        (0, 90, -90, 10, 30, 0),
        (-170, 200, -89.9999999, -500, 60, 280),
    ],
    ids=["wrist", "wrist nearly", "wrist folded", "elbow stretched", "elbow nearly"],
)
def test_residual_holds_at_singular_postures(model, q_deg):
    q = np.radians(q_deg)
    T = dh_product(model, q)
    solutions = inverse(model, T, q)
    assert len(solutions) == 8
    assert max(np.abs(dh_product(model, s.q) - T).max() for s in solutions) < 1e-11


def test_free_wrist_angle_stays_where_it_was_at_the_singularity():
    q = np.radians((10, 20, -40, 30, 0.0, 50))
    assert np.degrees(inverse_near(UPENN, dh_product(UPENN, q), q)) == pytest.approx((10, 20, -40, 30, 0, 50), abs=1e-6)


@BOTH
@settings(max_examples=60)
@given(
    fraction=st.lists(st.floats(0.02, 0.98), min_size=6, max_size=6),
    nudge=st.lists(st.floats(-0.01, 0.01), min_size=6, max_size=6),
)
def test_nearest_solution_returns_to_its_posture_over_the_whole_range(model, fraction, nudge):
    q = model.q_min + np.array(fraction) * (model.q_max - model.q_min)
    assume(not singularities(model, q, tolerance=0.1))
    found = inverse_near(model, dh_product(model, q), q + nudge)
    assert np.abs(found - q).max() < 1e-7  # joint 4 spans 620 degrees: whole turns are kept apart too


def test_whole_turns_follow_the_nearby_posture():
    q = np.radians((90, 65, 15, -300, 60, 200))
    T = dh_product(UPENN, q)
    for j4, j6 in ((-300, 200), (-300, -160)):
        near = np.radians((90, 65, 15, j4, 60, j6))
        assert np.degrees(inverse_near(UPENN, T, near))[[3, 5]] == pytest.approx((j4, j6))


def test_out_of_reach_says_so():
    T = np.eye(4)
    T[:3, 3] = (1.0, 0.0, 0.3)
    assert inverse(UPENN, T) == []
    with pytest.raises(PlanError, match="out of reach"):
        inverse_near(UPENN, T, ELBOW_FORM)


def test_inside_the_shoulder_offset_is_out_of_reach():
    T = np.eye(4)
    T[:3, 3] = (0.05, 0.05, 0.5)
    assert inverse(UPENN, T) == []


def test_joint_limit_refusal_names_the_joint():
    q = ELBOW_FORM.copy()
    q[0] = math.radians(150.0)  # 40 degrees beyond the stop of joint 1
    with pytest.raises(PlanError, match=r"joint 1 would be at 150\.0 deg, allowed -180 to 110"):
        inverse_near(UPENN, dh_product(UPENN, q), q, max_move_rad=0.5)


def test_another_branch_is_taken_only_when_far_moves_are_allowed():
    q = ELBOW_FORM.copy()
    q[0] = math.radians(150.0)
    T = dh_product(UPENN, q)
    over_the_back = inverse_near(UPENN, T, q)
    assert np.abs(over_the_back - q).max() > 0.5
    assert np.abs(dh_product(UPENN, over_the_back) - T).max() < 1e-11


def test_a_far_target_is_refused_with_the_move_it_needs():
    near = ELBOW_FORM + np.array((0, 0, 0, 0, 0, 1.0))
    with pytest.raises(PlanError, match=r"joint 6 would have to move by 57\.3 deg"):
        inverse_near(UPENN, dh_product(UPENN, ELBOW_FORM), near, max_move_rad=0.5)


@pytest.mark.parametrize(
    ("q_deg", "names"),
    [
        ((0, 65, 15, 0, 100, 0), ()),
        ((0, 65, 15, 0, 0, 0), ("wrist",)),
        ((0, 65, -90, 0, 90, 0), ("elbow",)),
        ((0, 45, 0, 0, 90, 0), ("shoulder",)),
        ((0, 90, -90, 0, 180, 0), ("shoulder", "elbow", "wrist")),
    ],
)
def test_singularities_are_named(q_deg, names):
    assert singularities(UPENN, np.radians(q_deg)) == names


@pytest.mark.parametrize("offset_mm", [60.0, 80.0, 100.0])
def test_scan_region_is_reachable_in_the_elbow_form(offset_mm):
    down = forward(UPENN, ELBOW_FORM)
    worst_j1 = -math.inf
    for x in (-0.100, -0.120, -0.140):
        for y in (-0.105, -0.1225, -0.140):
            for z in (0.364, 0.374):
                T = down.copy()
                T[:3, 3] = (x, y, z + 0.040)
                q = inverse_near(UPENN, T @ np.linalg.inv(tool_z_offset(offset_mm)), ELBOW_FORM)
                assert not singularities(UPENN, q)
                worst_j1 = max(worst_j1, q[0])
    assert 110.0 - math.degrees(worst_j1) == pytest.approx(2.5, abs=0.1)  # published check of the inner corner


# Start poses: the probe stands on the surface with its pole against the normal.

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


# Damped inverse velocity: exact away from singular poses, bounded at them.


def jacobian(q):
    return forward_jacobian(UPENN, q, TOOL)[1]


def test_exact_inverse_in_the_scan_pose():
    J = jacobian(ELBOW_FORM)
    twist = np.array((0.025, -0.01, 0.004, 0.3, -0.2, 0.1))
    assert J @ damped_step(J, twist) == pytest.approx(twist, abs=1e-12)


def test_rates_stay_bounded_and_continuous_through_the_wrist_singularity():
    twist = np.array((0.0, 0.0, 0.0, 0.0, 0.5, 0.5))
    before = None
    for q5 in np.radians(np.linspace(-8.0, 8.0, 161)):
        q = ELBOW_FORM.copy()
        q[4] = q5
        qd = damped_step(jacobian(q), twist)
        assert np.abs(qd).max() < 0.71 / 0.05 / 2 * 1.01 + 1.0
        if before is not None:
            assert np.abs(qd - before).max() < 2.0
        before = qd


def test_exactly_singular_gives_a_finite_step():
    q = ELBOW_FORM.copy()
    q[4] = 0.0
    assert np.all(np.isfinite(damped_step(jacobian(q), np.ones(6))))


def test_speed_limit_keeps_the_direction():
    J = jacobian(ELBOW_FORM)
    twist = np.array((1.0, 0.5, -0.4, 0.0, 0.0, 0.0))
    free = damped_step(J, twist)
    limited = damped_step(J, twist, qd_max=UPENN.qd_max / 10)
    assert np.max(np.abs(limited) / UPENN.qd_max) == pytest.approx(0.1)
    assert limited / np.linalg.norm(limited) == pytest.approx(free / np.linalg.norm(free))
    assert damped_step(J, 1e-3 * twist, qd_max=UPENN.qd_max) == pytest.approx(1e-3 * free)


@pytest.mark.parametrize("smallest", [0.07, 0.04, 0.004])
def test_damping_rises_by_its_law_below_the_threshold(smallest):
    """A Jacobian of known singular values: every direction is damped by λ² = 0.05² (1 - (s / 0.08)²)."""
    rng = np.random.default_rng(3)
    U, V = (np.linalg.qr(rng.normal(size=(6, 6)))[0] for _ in range(2))
    s = np.array([2.0, 1.5, 1.0, 0.7, 0.3, smallest])
    lambda2 = 0.05**2 * (1 - (smallest / 0.08) ** 2)
    twist = rng.normal(size=6)
    rates = V @ (s / (s**2 + lambda2) * (U.T @ twist))
    assert damped_step((U * s) @ V.T, twist, length_m=1.0) == pytest.approx(rates, rel=1e-9)


# Moving the tool with the motors that are left: against the forward kinematics, with the wrist's coupling.

MOVE = np.array((0.6, -0.5, 0.9)) * 1e-4


def stepped(free, move=MOVE, q=ELBOW_FORM):
    return lifting_step(forward_jacobian(UPENN, q, TOOL)[1][:3], UPENN.joints_per_count, move, np.array(free, bool))


def moved(counts, q=ELBOW_FORM):
    after = counts_to_joints(UPENN, joints_to_counts(UPENN, q) + counts)
    return (forward(UPENN, after) @ TOOL)[:3, 3] - (forward(UPENN, q) @ TOOL)[:3, 3]


@pytest.mark.parametrize("lost", [(), (0,), (1,), (2,), (3,), (4,), (5,), (0, 2), (3, 4, 5)])
def test_the_motors_that_are_left_make_the_move(lost):
    counts = stepped([i not in lost for i in range(6)])
    assert all(counts[i] == 0.0 for i in lost)
    assert moved(counts) == pytest.approx(MOVE, abs=2e-3 * np.linalg.norm(MOVE)), "the arc's second order is left"


def test_with_all_motors_no_other_step_turns_the_joints_less():
    counts = stepped([True] * 6)
    dq = UPENN.joints_per_count @ counts
    J = forward_jacobian(UPENN, ELBOW_FORM, TOOL)[1][:3]
    assert J @ dq == pytest.approx(MOVE, abs=1e-12)
    with_motors_4_to_6 = UPENN.joints_per_count @ stepped([True] * 3 + [False] * 3)
    assert np.linalg.norm(dq) < np.linalg.norm(with_motors_4_to_6)


@pytest.mark.parametrize("free", [(5,), (3, 4), (0, 3, 4, 5)])
def test_a_move_that_the_motors_cannot_make_is_none(free):
    assert stepped([i in free for i in range(6)]) is None


@pytest.mark.parametrize(("bent", "possible"), [(1e-3, False), (0.1, False), (0.4, True)])
def test_motors_that_are_badly_placed_for_a_move_are_not_asked(bent, possible):
    """Back along an arm that is nearly stretched out, without the wrist."""
    q = np.array((0.3, 0.4, bent - np.pi / 2, 0.0, 0.2, 0.0))
    x, y, _ = (forward(UPENN, q) @ TOOL)[:3, 3]
    back = -1e-4 * np.array((x, y, 0.0)) / np.hypot(x, y)
    counts = stepped([True] * 3 + [False] * 3, back, q)
    assert (counts is not None) is possible
    assert counts is None or moved(counts, q) == pytest.approx(back, abs=2e-6)
