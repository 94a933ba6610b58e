"""Ideal arm: exact against the matrix exponential, independent of how time is cut, honest at the ramp's ends."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from puma_arm import ELBOW_FORM, UPENN
from scipy.linalg import expm

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.ideal_arm import IdealArm, natural_frequency, transition
from canprobe.cell.plant.plant import Plant
from canprobe.mechanics.robot.model import joints_to_units, units_to_joints

MS = 1_000_000


def arm():
    return IdealArm(UPENN, ELBOW_FORM)


def counts(a):
    return np.array(a.motors()[0])


def rates(a):
    return np.array(a.motors()[1])


def reference_run(a, start, ramps, t_ns):
    """Position and rate of one motor by the matrix exponential of (q, v, r, slope)."""
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1] = (-(a.w**2), -2 * a.w, a.w**2, 0.0)
    x, now = np.array((start, 0.0, start, 0.0)), 0
    for t0, t1, r0, r1 in ramps:
        x, now = expm(A * 1e-9 * (t0 - now)) @ x, t0
        x[2:] = r0, (r1 - r0) / (1e-9 * (t1 - t0))
        x, now = expm(A * 1e-9 * (t1 - now)) @ x, t1
        x[2:] = r1, 0.0
    return expm(A * 1e-9 * (t_ns - now)) @ x


@settings(max_examples=25)
@given(t=st.floats(0.0, 0.2))
def test_transition_is_the_matrix_exponential(t):
    w = 120.0
    expected = expm(np.array([[0.0, 1.0], [-w * w, -2 * w]]) * t)
    assert np.array(transition(w, t)).reshape(2, 2) == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_bandwidth_is_the_minus_3_db_frequency():
    w, s = natural_frequency(30.0), 2j * math.pi * 30.0
    assert abs(w * w / (s * s + 2 * w * s + w * w)) == pytest.approx(1 / math.sqrt(2))


def test_ramps_and_holds_are_solved_exactly():
    a = arm()
    start = float(counts(a)[2])
    ramps = [
        (0, 5 * MS, start, start + 40.0),
        (5 * MS, 10 * MS, start + 40.0, start + 10.0),
        (20 * MS, 22 * MS, start, start - 7.0),
    ]
    for t0, t1, r0, r1 in ramps:
        a.advance(t0)
        a.set_ramp(2, r0, r1, t0, t1)
    for t in (22 * MS, 25 * MS, 40 * MS):
        a.advance(t)
        q, v, _, _ = reference_run(a, start, ramps, t)
        assert (counts(a)[2], rates(a)[2]) == pytest.approx((q, v), abs=1e-6)


@settings(max_examples=25)
@given(
    cuts=st.lists(st.integers(1, 60 * MS), max_size=12),
    targets=st.lists(st.floats(-300, 300), min_size=4, max_size=4),
)
def test_any_cutting_of_time_gives_the_same_state(cuts, targets):
    once, often = arm(), arm()
    start = float(counts(once)[1])
    for a, stops in ((once, []), (often, sorted(cuts))):
        value = start
        for k, target in enumerate(targets):
            t0 = 10 * MS * k
            for t in stops:
                if t0 - 10 * MS < t < t0:
                    a.advance(t)
                    assert np.all(np.isfinite(counts(a)))
            a.advance(t0)
            a.set_ramp(1, value, start + target, t0, t0 + 5 * MS)
            value = start + target
        for t in stops:
            a.advance(t)
            a.torque_permille(1)
        a.advance(60 * MS)
    assert np.array_equal(counts(once), counts(often))
    assert np.array_equal(rates(once), rates(often))


def test_steady_ramp_lags_by_two_over_the_frequency():
    a = arm()
    start = float(counts(a)[0])
    a.set_ramp(0, start, start + 10_000.0, 0, 1000 * MS)
    a.advance(500 * MS)
    assert start + 5000.0 - counts(a)[0] == pytest.approx(10_000.0 * a.lag_s)
    assert rates(a)[0] == pytest.approx(10_000.0)
    assert a.lag_s == pytest.approx(2.0 / a.w)


def test_motors_not_joints_hold_the_wrist():
    """Joint 4 turned alone by its motor drags joints 5 and 6: the master has to decouple."""
    a = arm()
    goal = joints_to_units(UPENN, ELBOW_FORM + np.array((0, 0, 0, 0.1, 0, 0)))
    a.set_ramp(3, counts(a)[3], goal[3], 0, MS)
    a.advance(2000 * MS)
    moved = units_to_joints(UPENN, counts(a)) - ELBOW_FORM
    assert moved[3] == pytest.approx(0.1)
    assert moved[4] == pytest.approx(0.1 * 9.8462 / 39.3846, rel=1e-4)


def test_a_new_ramp_replaces_the_old_one_and_what_was_to_come():
    a = arm()
    start = float(counts(a)[0])
    a.set_ramp(0, start, start + 1000.0, 0, 100 * MS)
    a.set_ramp(0, start, start + 500.0, 50 * MS, 60 * MS)
    a.set_ramp(0, start, start - 20.0, 10 * MS, 12 * MS)
    a.advance(2000 * MS)
    assert counts(a)[0] == pytest.approx(start - 20.0)


def test_a_late_ramp_acts_from_now_on():
    a, b = arm(), arm()
    start = float(counts(a)[0])
    for one in (a, b):
        one.advance(10 * MS)
    a.set_ramp(0, start, start + 100.0, 0, 20 * MS)
    b.set_ramp(0, start + 50.0, start + 100.0, 10 * MS, 20 * MS)
    assert counts(a)[0] == start
    for one in (a, b):
        one.advance(15 * MS)
    assert counts(a)[0] == pytest.approx(counts(b)[0], abs=1e-9)


def test_a_step_is_a_ramp_without_length():
    a = arm()
    start = float(counts(a)[0])
    a.set_ramp(0, start, start + 10.0, 0, 0)
    a.advance(3 * MS)
    tau = 0.003 * a.w
    assert counts(a)[0] - start == pytest.approx(10.0 * (1 - (1 + tau) * math.exp(-tau)))


def test_torque_is_zero_at_rest_and_follows_motion():
    a = arm()
    assert [a.torque_permille(i) for i in range(6)] == [0] * 6
    start = float(counts(a)[0])
    a.set_ramp(0, start, start + 46.72e3 / (2 * math.pi), 0, 1000 * MS)  # joint 1 at 1 rad/s
    a.advance(700 * MS)
    assert a.torque_permille(0) == pytest.approx(1000 * (2.2 + 0.32) / 6.4, abs=1)


def test_torque_is_kept_within_the_peak():
    a = arm()
    a.set_ramp(0, counts(a)[0] + 1e6, counts(a)[0] + 1e6, 0, 0)
    a.advance(MS)
    assert a.torque_permille(0) == 2000


def test_motor_dynamics_of_joint_1():
    gain, coulomb, damping = Plant(PlantConfig(UPENN, ELBOW_FORM)).motor_dynamics(0)
    counts_per_rad = 46720 / (2 * math.pi)
    assert gain == pytest.approx(6.4e-3 / 0.030 * counts_per_rad, rel=1e-4)
    assert coulomb == pytest.approx(1000 * 2.2 / 6.4)
    assert damping == pytest.approx(0.32 / 0.030)
