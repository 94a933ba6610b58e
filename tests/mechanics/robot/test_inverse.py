"""Inverse kinematics of arms of 3 to 8 joints: it comes back to the posture, and says what it cannot reach."""

import math
from dataclasses import replace

import numpy as np
import pytest
from published_puma import ELBOW_FORM, MODELS, UPENN
from serial_arms import five, gantry, model_of, random_chain, scara, seven

from canprobe.errors import PlanError
from canprobe.mechanics.robot.chain import forward, forward_jacobian
from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset
from canprobe.mechanics.robot.inverse import (
    ERROR_LENGTH_M,
    damped_step,
    in_rows,
    inverse_near,
    lifting_step,
    rolls_last,
    task_rows,
)
from canprobe.mechanics.robot.model import joints_to_units, units_to_joints
from canprobe.mechanics.robot.probe_poses import probe_pose, start_posture

TOOL = tool_z_offset(80.0)
POINT = np.array((-0.120, -0.1225, 0.374))
ARMS = {model.name: model for model in (*MODELS.values(), gantry(), scara(), five(), seven())}
ARMS |= {f"random {n}": model_of(random_chain(np.random.default_rng(n), n), slide=(-0.6, 0.6)) for n in (5, 6, 7, 8)}
EACH = pytest.mark.parametrize("model", ARMS.values(), ids=ARMS)


def pose(model, q, tool=TOOL):
    return forward(model.chain, q) @ tool


def away(model, q, T_base_tool):
    """What is left of the rows that the arm holds: m, and what the angles between the axes leave over."""
    T = pose(model, q)
    turn = {3: 0.0, 5: T[:3, 2] - T_base_tool[:3, 2], 6: T[:3, :3] - T_base_tool[:3, :3]}[task_rows(model)]
    return max(np.abs(T[:3, 3] - T_base_tool[:3, 3]).max(), np.abs(turn).max())


def test_rows_follow_from_the_number_of_joints():
    rows = {n: task_rows(model_of(random_chain(np.random.default_rng(n), n))) for n in range(1, 9)}
    assert rows == {1: 3, 2: 3, 3: 3, 4: 3, 5: 5, 6: 6, 7: 6, 8: 6}


def test_five_rows_are_those_that_the_pole_needs():
    T, J = forward_jacobian(five().chain, np.array((0.3, 0.5, -0.7, 0.4, 1.0)), TOOL)
    rows, turn = in_rows(5, T[:3, :3], J), np.array((0.0, 0.0, 0.0, *(0.7 * T[:3, 2])))
    assert rows[:3] == pytest.approx(J[:3])
    assert np.cross(J[3:].T, T[:3, 2]) == pytest.approx(np.cross(rows[3:].T @ T[:3, :2].T, T[:3, 2]))
    assert in_rows(5, T[:3, :3], turn) == pytest.approx(np.zeros(5), abs=1e-15)


@EACH
def test_it_comes_back_to_the_posture_that_made_the_pose(model):
    """Well inside the stops and off singular poses; joints that the rows do not need stay where they were."""
    rng = np.random.default_rng(5)
    for _ in range(40):
        q = model.q_min + rng.uniform(0.15, 0.85, model.n) * (model.q_max - model.q_min)
        T, J = forward_jacobian(model.chain, q, TOOL)
        if np.linalg.svd(in_rows(task_rows(model), T[:3, :3], J))[1][-1] < 0.08:
            continue
        near = q + rng.uniform(-0.02, 0.02, model.n) * model.radian
        found = inverse_near(model, T, TOOL, near)
        assert away(model, found, T) < 2e-9
        assert np.all(found >= model.q_min) and np.all(found <= model.q_max)
        if task_rows(model) == model.n:
            assert found == pytest.approx(q, abs=1e-7)
        else:
            _, J = forward_jacobian(model.chain, found, TOOL)
            rows = in_rows(task_rows(model), T[:3, :3], J) * model.radian
            back = (near - found) / model.radian  # what the pose leaves free stays: nothing of it in the null space
            free = back - np.linalg.pinv(rows) @ (rows @ back)
            inside = np.all((found > model.q_min + 1e-9) & (found < model.q_max - 1e-9))
            assert not inside or np.abs(free).max() < 1e-6


@pytest.mark.parametrize("q_deg", [(10, 20, -40, 30, 0.0, 50), (0, 90, -90, 10, 30, 0)], ids=str)
def test_it_reaches_singular_postures_from_beside_them(q_deg):
    q = np.radians(q_deg)
    found = inverse_near(UPENN, pose(UPENN, q), TOOL, q + np.array((0.01, -0.01, 0.02, 0.01, 0.02, -0.01)))
    assert away(UPENN, found, pose(UPENN, q)) < 2e-9


def test_whole_turns_follow_the_nearby_posture():
    T = pose(UPENN, np.radians((90, 65, 15, -300, 60, 200)))
    near = np.radians((91, 66, 15, -298, 60, -161))
    assert np.degrees(inverse_near(UPENN, T, TOOL, near))[[3, 5]] == pytest.approx((-300, -160))


@pytest.mark.parametrize("model", [UPENN, five()], ids=lambda model: model.name)
def test_out_of_reach_names_the_nearest_pose(model):
    q = 0.5 * (model.q_min + model.q_max) + 0.3
    T = pose(model, q)
    T[:3, 3] = (3.0, 0.0, 0.3)
    with pytest.raises(PlanError, match=r"tool at \(3000.0, 0.0, 300.0\) mm: out of reach of the") as refused:
        inverse_near(model, T, TOOL, q)
    assert "nearest reachable: tool at (" in str(refused.value) and "mm and " in str(refused.value)


def test_the_nearest_pose_of_a_gantry_is_where_its_axes_end():
    model = gantry()
    T = pose(model, (0.3, 0.3, 0.3))
    T[:3, 3] += (0.4, 0.1, 0.0)
    with pytest.raises(PlanError, match=r"100.0 mm and 0.0 deg away with joint 1 at its stop, 600.0 mm"):
        inverse_near(model, T, TOOL, (0.3, 0.3, 0.3))


def test_beyond_a_stop_the_joint_at_it_is_named():
    q = ELBOW_FORM.copy()
    q[0] = math.radians(150.0)  # 40 degrees beyond the stop of joint 1
    with pytest.raises(PlanError, match=r"out of reach.* joint 1 at its stop, 110\.0 deg"):
        inverse_near(UPENN, pose(UPENN, q), TOOL, ELBOW_FORM)


def test_a_far_target_is_refused_with_the_move_it_needs():
    near = ELBOW_FORM + np.array((0, 0, 0, 0, 0, 1.0))
    with pytest.raises(PlanError, match=r"joint 6 would have to move by 57\.3 deg"):
        inverse_near(UPENN, pose(UPENN, ELBOW_FORM), TOOL, near, max_move_rad=0.5)
    with pytest.raises(PlanError, match=r"joint 1 would have to move by 200\.0 mm"):
        inverse_near(gantry(), pose(gantry(), (0.5, 0.3, 0.3)), TOOL, (0.3, 0.3, 0.3), max_move_rad=0.5)


def test_seven_joints_go_back_to_the_posture_of_rest():
    model = seven()
    rest = np.array((0.2, 0.5, 0.1, -1.2, 0.3, 0.8, 0.4))
    T = pose(model, rest)
    other = inverse_near(model, T, TOOL, rest, q_rest=rest + np.array((0, 0, 0.4, 0, 0, 0, 0)))
    assert np.abs(other - rest).max() > 0.1 and away(model, other, T) < 2e-9
    assert inverse_near(model, T, TOOL, other, q_rest=rest) == pytest.approx(rest, abs=1e-6)


# Start poses: the probe stands on the surface with its pole against the normal.


def test_probe_pose_is_a_rotation_with_the_pole_against_the_normal():
    normal = np.array((0.1, -0.2, 1.0))
    T = probe_pose(POINT, normal, 0.0397, (1.0, 0.0, 0.0))
    n = normal / np.linalg.norm(normal)
    assert T[:3, :3] @ T[:3, :3].T == pytest.approx(np.eye(3), abs=1e-14)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert T[:3, 2] == pytest.approx(-n)
    assert (T[:3, 3] - POINT) @ n == pytest.approx(0.0397)
    assert T[:3, 0] @ np.array((1.0, 0.0, 0.0)) > 0.9


def test_start_posture_of_the_default_scan_point():
    q = start_posture(UPENN, POINT, (0, 0, 1), ELBOW_FORM, radius_m=0.040, T_flange_probe=TOOL, clearance_m=0.005)
    T = pose(UPENN, q)
    assert T[:3, 3] == pytest.approx(POINT + np.array((0, 0, 0.045)), abs=1e-9)
    assert T[:3, 2] == pytest.approx((0, 0, -1), abs=1e-9)
    assert np.abs(q - ELBOW_FORM).max() < math.radians(10.0)


def test_unreachable_and_degenerate_requests_are_refused():
    with pytest.raises(PlanError, match="out of reach"):
        start_posture(UPENN, (0.9, 0, 0), (0, 0, 1), ELBOW_FORM, radius_m=0.04, T_flange_probe=TOOL)
    with pytest.raises(ValueError, match="parallel"):
        probe_pose(POINT, (0, 0, 1), 0.04, (0, 0, 2))


# Damped inverse velocity: exact away from singular poses, bounded at them.


def jacobian(q):
    return forward_jacobian(UPENN.chain, q, TOOL)[1]


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


def test_more_joints_than_rows_move_least_and_as_wished():
    J = forward_jacobian(seven().chain, np.array((0.2, 0.5, 0.1, -1.2, 0.3, 0.8, 0.4)), TOOL)[1]
    twist, wish = np.array((0.02, -0.01, 0.03, 0.1, 0.2, -0.1)), np.array((0.1, -0.2, 0.3, 0.0, 0.1, 0.2, -0.3))
    least = damped_step(J, twist)
    assert least == pytest.approx(np.linalg.pinv(J) @ twist)
    moved = damped_step(J, twist, wish)
    assert J @ moved == pytest.approx(twist) and moved - least == pytest.approx(wish - np.linalg.pinv(J) @ (J @ wish))


def test_fewer_joints_than_rows_come_as_near_as_they_can():
    J = np.random.default_rng(1).normal(size=(3, 2))
    twist = np.array((0.1, 0.2, -0.3))
    assert damped_step(J, twist) == pytest.approx(np.linalg.lstsq(J, twist, rcond=None)[0])


@pytest.mark.parametrize("smallest", [0.07, 0.004])
def test_damping_rises_by_its_law_below_the_threshold(smallest):
    """A Jacobian of known singular values: every direction is damped by λ² = 0.05² (1 - (s / 0.08)²)."""
    rng = np.random.default_rng(3)
    U, V = (np.linalg.qr(rng.normal(size=(6, 6)))[0] for _ in range(2))
    s = np.array([2.0, 1.5, 1.0, 0.7, 0.3, smallest])
    lambda2 = 0.05**2 * (1 - (smallest / 0.08) ** 2)
    twist = rng.normal(size=6)
    rates = V @ (s / (s**2 + lambda2) * (U.T @ twist))
    metres = np.array((ERROR_LENGTH_M,) * 3 + (1.0,) * 3)
    assert damped_step(metres[:, None] * (U * s) @ V.T, metres * twist) == pytest.approx(rates, rel=1e-9)


# Moving the tool with the motors that are left: against the forward kinematics, with the wrist's coupling.

MOVE = np.array((0.6, -0.5, 0.9)) * 1e-4


def stepped(free, move=MOVE, q=ELBOW_FORM):
    return lifting_step(UPENN, forward_jacobian(UPENN.chain, q, TOOL)[1][:3], move, np.array(free, bool))


def moved(counts, q=ELBOW_FORM):
    after = units_to_joints(UPENN, joints_to_units(UPENN, q) + counts)
    return (forward(UPENN.chain, after) @ TOOL)[:3, 3] - (forward(UPENN.chain, q) @ TOOL)[:3, 3]


@pytest.mark.parametrize("lost", [(), (1,), (4,), (0, 2), (3, 4, 5)])
def test_the_motors_that_are_left_make_the_move(lost):
    counts = stepped([i not in lost for i in range(6)])
    assert all(counts[i] == 0.0 for i in lost)
    assert moved(counts) == pytest.approx(MOVE, abs=2e-3 * np.linalg.norm(MOVE)), "the arc's second order is left"


@pytest.mark.parametrize("free", [(5,), (0, 3, 4, 5)])
def test_a_move_that_the_motors_cannot_make_is_none(free):
    assert stepped([i in free for i in range(6)]) is None


@pytest.mark.parametrize(("bent", "possible"), [(0.1, False), (0.4, True)])
def test_motors_that_are_badly_placed_for_a_move_are_not_asked(bent, possible):
    """Back along an arm that is nearly stretched out, without the wrist."""
    q = np.array((0.3, 0.4, bent - np.pi / 2, 0.0, 0.2, 0.0))
    x, y, _ = (forward(UPENN.chain, q) @ TOOL)[:3, 3]
    back = -1e-4 * np.array((x, y, 0.0)) / np.hypot(x, y)
    counts = stepped([True] * 3 + [False] * 3, back, q)
    assert (counts is not None) is possible
    assert counts is None or moved(counts, q) == pytest.approx(back, abs=2e-6)


@pytest.mark.parametrize("model", [gantry(), seven()], ids=lambda model: model.name)
def test_drives_of_other_arms_make_the_move_too(model):
    q = 0.5 * (model.q_min + model.q_max) + 0.4 * model.radian
    T, J = forward_jacobian(model.chain, q, TOOL)
    units = lifting_step(model, J[:3], MOVE, np.ones(model.n, bool))
    after = units_to_joints(model, joints_to_units(model, q) + units)
    assert pose(model, after)[:3, 3] - T[:3, 3] == pytest.approx(MOVE, abs=2e-3 * np.linalg.norm(MOVE))


@pytest.mark.parametrize("tilt_deg", [0.0, 180.0])
def test_five_joints_of_which_the_last_rolls_hold_the_position_alone(tilt_deg):
    """A roll about the pole turns nothing of position and pole: the others hold what four joints hold."""
    chain = five().chain
    flange = np.eye(4)
    flange[1:3, 1:3] = math.cos(math.radians(tilt_deg)) * np.eye(2)
    flange[2, 3] = 0.1
    model = model_of(replace(chain, T_last_flange=flange))
    q = np.array((0.3, 0.5, -0.7, 0.4, 1.0))
    assert rolls_last(model) and task_rows(model) == 3 and task_rows(five()) == 5
    T = pose(model, q)
    T[:3, 3] += (0.01, -0.02, 0.015)
    found = inverse_near(model, T, TOOL, q)
    assert pose(model, found)[:3, 3] == pytest.approx(T[:3, 3], abs=1e-9)
    assert found[4] == pytest.approx(q[4]), "the roll stays where it was"
