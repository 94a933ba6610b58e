"""The push on a tool by the torques of the motors, against statics computed by finite differences."""

import numpy as np
import pytest
from published_puma import UPENN

from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.model import joints_per_motor
from canprobe.mechanics.robot.tool_push import PushGeometry, TorqueMean, push_since

Q = np.radians([90.0, 65.0, 15.0, 0.0, 100.0, 10.0])
TOOL = np.eye(4)
TOOL[2, 3] = 0.12
MOVING = 0.2 * np.ones(6)
GEOMETRY = PushGeometry(UPENN, TOOL)


def mean_of(torque, *, rate=MOVING, q=Q, variance=1e-8, force=0.0):
    return TorqueMean(
        torque,
        np.full(6, variance),
        20,
        q,
        GEOMETRY.motors(q),
        0.1 * rate,
        0.1,
        0.05 * rate,
        force,
        0.05,
    )


def pushed(newtons):
    """Torques of the motors under a push against the pole, by the work of a small motion of each motor."""
    T = forward(UPENN.chain, Q) @ TOOL
    per_motor = joints_per_motor(UPENN)
    ways = [((forward(UPENN.chain, Q + 1e-6 * per_motor[:, k]) @ TOOL - T)[:3, 3] @ T[:3, 2]) / 1e-6 for k in range(6)]
    return newtons * np.array(ways)


def test_a_push_and_a_pull_are_found_with_their_size():
    free = np.array([2.0, -1.0, 0.5, 0.1, 0.1, 0.05])
    before = [mean_of(free) for _ in range(5)]
    for newtons in (6.0, -6.0):
        push, sigma = push_since(GEOMETRY, mean_of(free + pushed(newtons)), before)
        assert push == pytest.approx(newtons, rel=1e-4)
        assert sigma < 1.0
    none, _ = push_since(GEOMETRY, mean_of(free), before)
    assert none == pytest.approx(0.0, abs=1e-9)


def test_motors_at_rest_hide_a_push_in_their_friction():
    """7 N of joint 1 at 0.3 m are its Coulomb friction: who stands still says so much less."""
    still = np.zeros(6)
    _, moving = push_since(GEOMETRY, mean_of(still), [mean_of(still)] * 5)
    _, resting = push_since(GEOMETRY, mean_of(still, rate=still), [mean_of(still, rate=still)] * 5)
    assert resting > 3 * moving
    _, turned = push_since(GEOMETRY, mean_of(still, rate=-MOVING), [mean_of(still)] * 5)
    assert turned > resting  # friction that has changed its sense


def test_posture_and_noise_add_to_the_deviation():
    still = np.zeros(6)
    _, quiet = push_since(GEOMETRY, mean_of(still), [mean_of(still)] * 5)
    _, noisy = push_since(GEOMETRY, mean_of(still, variance=1.0), [mean_of(still, variance=1.0)] * 5)
    elsewhere = [mean_of(still, q=Q - 0.3)] * 5
    _, moved = push_since(GEOMETRY, mean_of(still), elsewhere)
    assert noisy > quiet and moved > 5 * quiet


def test_motors_without_torque_say_nothing():
    unknown = np.full(6, np.nan)
    push, sigma = push_since(GEOMETRY, mean_of(unknown), [mean_of(unknown)] * 5)
    assert push == 0.0 and np.isinf(sigma)
