"""Inverse kinematics: all branches close, angles land in the ranges, refusals name the joint."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from canprobe.errors import PlanError
from canprobe.robot.inverse import inverse, inverse_near, singularities
from canprobe.robot.kinematics import forward, tool_z_offset
from canprobe.robot.puma260 import ELBOW_FORM, MODELS, UPENN

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
