"""The joint of an emulated motor: it follows the MIT law as its closed form does, and nothing makes it diverge."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from scipy.linalg import expm

from canprobe.fieldbus.motor.joint import MotorJoint
from canprobe.fieldbus.motor.protocol import KD_MAX, KP_MAX, TYPES, MitCommand

UNLIMITED = 1e9


def joint(name="dm4310", *, coulomb=0.0, q=0.0):
    made = MotorJoint(TYPES[name], q)
    made.coulomb = coulomb
    return made


def end_of(made, command, seconds, h, limit=UNLIMITED):
    for _ in range(round(seconds / h)):
        made.step(h, command, limit)
    return made.q, made.qd


def closed_form(made, command, seconds):
    """q and q̇ after a time, of the linear joint: the exponential of its matrix."""
    p, v, kp, kd, t = command
    a = np.array([[0, 1, 0], [-kp, -kd - made.viscous, kp * p + kd * v + t], [0, 0, 0]])
    a[1] /= made.inertia
    return (expm(a * seconds) @ [made.q, made.qd, 1.0])[:2]


@pytest.mark.parametrize(("kp", "kd"), [(10.0, 1.0), (500.0, 5.0), (500.0, 0.0), (0.0, 5.0)])
def test_the_error_is_of_first_order_in_the_step(kp, kd):
    command = MitCommand(0.4, 1.0, kp, kd, 0.5)
    truth = closed_form(joint(), command, 0.02)
    errors = [np.abs(np.subtract(end_of(joint(), command, 0.02, h), truth)) for h in (50e-6, 25e-6)]
    assert errors[0][0] < 0.02 * 0.4
    assert errors[0][0] / errors[1][0] == pytest.approx(2.0, abs=0.25)


@pytest.mark.parametrize("name", TYPES)
@pytest.mark.parametrize("h", [50e-6, 1e-3, 25e-3, 1.0])
def test_no_step_makes_the_stiffest_command_diverge_or_swing(name, h):
    """The distance from the target only falls once the joint is there, with the limit of the torque and friction."""
    ranges = TYPES[name]
    made, command = MotorJoint(ranges, 3.0), MitCommand(kp=KP_MAX, kd=KD_MAX)
    seen = []
    for _ in range(max(round(1.0 / h), 200)):
        made.step(h, command, ranges.t)
        seen.append(abs(made.q))
        assert abs(made.tau) <= ranges.t
    assert max(seen) <= 3.0 + 1e-9
    assert seen[-1] <= made.coulomb / KP_MAX + 1e-6, "friction alone holds it off the target"


@pytest.mark.parametrize("seed", range(6))
def test_any_commands_in_steps_of_any_length_stay_within_what_the_torque_can_do(seed):
    rng = random.Random(seed)
    ranges = TYPES[rng.choice(list(TYPES))]
    made = MotorJoint(ranges)
    fastest = ranges.t / made.viscous
    for _ in range(2000):
        command = MitCommand(*(rng.choice((low, 0.0, high, rng.uniform(low, high))) for low, high, _ in ranges.fields))
        made.step(10 ** rng.uniform(-6, 1), command, ranges.t)
        assert math.isfinite(made.q)
        assert abs(made.qd) <= fastest * (1 + 1e-9)


def test_friction_holds_up_to_its_size_and_no_further():
    held, moved = joint(coulomb=0.05), joint(coulomb=0.05)
    assert end_of(held, MitCommand(t=0.049), 0.1, 50e-6) == (0.0, 0.0)
    assert end_of(moved, MitCommand(t=0.051), 0.1, 50e-6)[0] > 0
    moved.qd = 1.0
    end_of(moved, MitCommand(), 1.0, 50e-6)
    assert moved.qd == 0.0, "a free joint comes to rest"


def test_without_a_load_the_joint_is_where_the_law_holds_it():
    made = joint()
    q, qd = end_of(made, MitCommand(p=1.0, kp=50.0, kd=1.0, t=2.0), 2.0, 50e-6)
    assert (q, qd) == pytest.approx((1.0 + 2.0 / 50.0, 0.0), abs=1e-6)
