"""The way that a probe has come, and the way back on it."""

from __future__ import annotations

import numpy as np
import pytest
from puma_arm import ELBOW_FORM

import canprobe
from canprobe.cell.master.trail import (
    ARRIVAL_S,
    GROWTH_N,
    GROWTH_SHARE,
    MAX_KNOTS,
    START_S,
    WAY_BACK,
    WAY_BACK_SPEED,
    GrowingForce,
    TakenWay,
)
from canprobe.mechanics.robot.chain import forward

PLAN = canprobe.plan("press")
MODEL, T_FLANGE_PROBE = PLAN.setup.arm.model, PLAN.setup.probe.T_flange_probe
PERIOD_S = 2.5e-3
STEP_MAX = MODEL.qd_max * PERIOD_S


def walked(joints, ages=(0,) * 6):
    trail = TakenWay(MODEL, T_FLANGE_PROBE)
    for q in joints:
        trail.add(q, ages)
    return trail


def back(trail, q, step_max=STEP_MAX, dt=PERIOD_S):
    way, targets = trail.back(q, step_max), [q]
    while (q := way.step(dt)) is not None:
        targets.append(q)
    return np.array(targets)


def place(q):
    return (forward(MODEL.chain, q) @ T_FLANGE_PROBE)[:3, 3]


def ways(joints):
    places = np.array([place(q) for q in joints])
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])


def bent(steps=2000, size=1.0):
    """A way that turns, of some 30 mm."""
    u = np.linspace(0.0, 1.0, steps)[:, None]
    return ELBOW_FORM + size * (u * np.array([0.08, -0.05, 0.04, 0.02, -0.03, 0.05]) + 0.02 * np.sin(5.0 * u))


@pytest.mark.parametrize("dt", [PERIOD_S, 1e-3, 7e-3])
def test_the_last_millimetres_are_gone_back_on_the_joints_that_were_measured(dt):
    joints = bent()
    targets = back(walked(joints), joints[-1], step_max=MODEL.qd_max * dt, dt=dt)
    off = [np.abs(joints - q).max(axis=1).min() for q in targets]
    assert max(off) < 1e-4
    assert ways(targets)[-1] == pytest.approx(WAY_BACK, rel=0.01)
    duration = START_S + WAY_BACK / WAY_BACK_SPEED + ARRIVAL_S
    assert len(targets) - 1 == pytest.approx(duration / dt, abs=2.0)


def test_it_leaves_quickly_but_not_at_once_and_comes_to_rest():
    joints = bent()
    speed = np.diff(ways(back(walked(joints), joints[-1]))) / PERIOD_S
    assert speed[0] < 0.15 * WAY_BACK_SPEED and np.abs(np.diff(speed)).max() < 0.3 * WAY_BACK_SPEED
    assert 1.7 * WAY_BACK_SPEED < speed.max() < 2.0 * WAY_BACK_SPEED and int(speed.argmax()) * PERIOD_S <= 1.5 * START_S
    assert speed[-round(ARRIVAL_S / PERIOD_S) :].max() < 0.02 * WAY_BACK_SPEED


def test_the_joints_keep_their_speed_limits_and_the_way_takes_longer():
    joints = bent()
    slow = 0.2 * np.abs(np.diff(back(walked(joints), joints[-1]), axis=0)).max()
    targets = back(walked(joints), joints[-1], step_max=np.full(6, slow))
    assert np.abs(np.diff(targets, axis=0)).max() < 1.1 * slow
    assert ways(targets)[-1] == pytest.approx(WAY_BACK, rel=0.01)


def test_it_begins_where_the_arm_stands_beside_the_last_position_that_was_kept():
    joints = bent()
    here = joints[-1] + 2e-4
    assert np.abs(back(walked(joints), here)[1] - here).max() < 5e-5


def test_a_short_way_is_gone_back_to_its_beginning():
    joints = bent(size=0.02)
    assert ways(joints)[-1] < 0.5 * WAY_BACK
    assert np.abs(back(walked(joints), joints[-1])[-1] - joints[0]).max() < 1e-9


def test_positions_that_were_carried_on_are_not_kept_and_a_way_that_was_forgotten_is_unknown():
    joints = bent()
    assert walked(joints, ages=(0, 0, 1, 0, 0, 0)).back(joints[-1], STEP_MAX) is None
    trail = walked(joints)
    trail.forget()
    assert trail.back(joints[-1], STEP_MAX) is None


def test_the_memory_is_bounded_where_the_probe_turns_about_its_tip_or_rests():
    trail = TakenWay(MODEL, T_FLANGE_PROBE)
    q = ELBOW_FORM.copy()
    for _ in range(4 * MAX_KNOTS):
        q = q + np.array([0, 0, 0, 0, 0, 1e-3])
        trail.add(q, (0,) * 6)
    assert len(trail._knots) <= MAX_KNOTS
    rest = walked(np.repeat(bent()[:1], 500, axis=0))
    assert len(rest._knots) == 1


def test_what_was_pressed_before_the_way_back_took_effect_is_no_growth():
    witness = GrowingForce(14)
    assert not any(witness.grows(100 + k, 2.0 + 0.1 * k, a_part=False) for k in range(14))
    most = 3.3 * (1.0 + GROWTH_SHARE) + GROWTH_N
    assert not witness.grows(114, most, a_part=False) and witness.grows(115, most + 1e-3, a_part=False)
    assert not witness.grows(116, 0.0, a_part=False)


def test_a_part_of_a_force_has_grown_unless_it_is_noise_at_the_edge_of_the_array():
    witness = GrowingForce(1)
    witness.grows(0, 2.0, a_part=False)
    assert witness.grows(1, 1.0, a_part=True) and not witness.grows(2, 0.9 * GROWTH_N, a_part=True)
