"""The joint guard at its borders: range, speed, and what a measured joint can have done."""

from __future__ import annotations

import numpy as np
import pytest

import canprobe
from canprobe.cell.joint_guard import JointGuard
from canprobe.cell.limits import limits_of
from canprobe.cell.measurement import Measurement
from canprobe.robot.puma260 import MODELS

PERIOD_NS = 2_500_000
TINY = 1e-6


@pytest.fixture(scope="module")
def scene():
    return canprobe.load_scene("cylinder")


@pytest.fixture(scope="module")
def limits(scene):
    return limits_of(canprobe.plan(scene))


def at(q, cycle):
    return Measurement(cycle, cycle * PERIOD_NS, q=np.array(q), q_age=(0,) * 6)


@pytest.mark.parametrize("axis", range(6))
def test_a_target_may_come_as_near_to_a_stop_as_the_margin(scene, limits, axis):
    model = MODELS[scene.arm.model]
    margin = np.radians(scene.limits.joint_margin_deg)
    assert margin > 0
    for border, inward in ((model.q_min, 1.0), (model.q_max, -1.0)):
        q = (model.q_min + model.q_max) / 2
        q[axis] = border[axis] + inward * (margin + TINY)
        guard = JointGuard(limits)
        assert guard.command(q, at(q, 0)).q is not None
        q[axis] -= 2 * inward * TINY
        answer = guard.command(q, at(q, 1))
        assert answer.q is None and answer.limit.startswith(f"joint {axis + 1} at ")


@pytest.mark.parametrize("axis", range(6))
def test_a_measured_motion_of_three_halves_of_the_speed_in_two_periods_is_the_most(scene, limits, axis):
    """A cycle's SYNC may come a period late, so two periods may have passed; two counts are the encoder's own."""
    model = MODELS[scene.arm.model]
    speed = model.qd_max[axis] * scene.limits.joint_speed_share
    most = 1.5 * speed * 2 * PERIOD_NS * 1e-9 + 2 * limits.count[axis]
    for share, believed in ((0.999, True), (-0.999, True), (1.001, False), (-1.001, False)):
        guard = JointGuard(limits)
        assert guard.measure(at(np.zeros(6), 0)) is None
        moved = np.zeros(6)
        moved[axis] = share * most
        told = guard.measure(at(moved, 1))
        assert (told is None) is believed
        assert believed or told.startswith(f"joint {axis + 1} reports a motion of {np.degrees(most):.1f} deg")


def test_a_target_too_far_is_approached_at_the_joints_speed(scene, limits):
    model = MODELS[scene.arm.model]
    q = (model.q_min + model.q_max) / 2
    step = model.qd_max * scene.limits.joint_speed_share * PERIOD_NS * 1e-9
    guard = JointGuard(limits)
    np.testing.assert_array_equal(guard.command(q + 0.999 * step, at(q, 0)).q, q + 0.999 * step)
    assert guard.slowed == 0
    third = np.eye(6)[2] * step
    assert JointGuard(limits).command(q + 3 * third, at(q, 0)).q == pytest.approx(q + third, abs=1e-12)


@pytest.mark.parametrize(
    "given",
    [np.ma.masked_all(6), np.zeros(6) + 0j, np.zeros(6, dtype=bool), ["0"] * 6, [None] * 6, [[0.0], [0.0, 0.0]], None],
    ids=["masked", "complex", "bool", "text", "nothing", "ragged", "None"],
)
def test_what_is_no_angle_is_never_sent(scene, limits, given):
    guard = JointGuard(limits)
    found = guard.command(given, at(np.radians(scene.arm.start_deg), 1))
    assert found.q is None and "expected 6" in found.limit
