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


def mean_of(model, torque, *, rate=MOVING, q=Q, variance=1e-8, force=0.0):
    return TorqueMean(
        torque,
        np.full(6, variance),
        20,
        q,
        PushGeometry(model, TOOL).motors(q),
        0.1 * rate,
        0.1,
        0.05 * rate,
        force,
        0.05,
    )


def pushed(model, newtons):
    """Torques of the motors under a push against the pole, by the work of a small motion of each motor."""
    T = forward(model.chain, Q) @ TOOL
    per_motor = joints_per_motor(model)
    ways = [((forward(model.chain, Q + 1e-6 * per_motor[:, k]) @ TOOL - T)[:3, 3] @ T[:3, 2]) / 1e-6 for k in range(6)]
    return newtons * np.array(ways)


def test_a_push_is_found_with_its_size():
    model = UPENN
    geometry = PushGeometry(model, TOOL)
    free = np.array([2.0, -1.0, 0.5, 0.1, 0.1, 0.05])
    before = [mean_of(model, free) for _ in range(5)]
    push, sigma = push_since(geometry, mean_of(model, free + pushed(model, 6.0)), before)
    assert push == pytest.approx(6.0, rel=1e-4)
    assert sigma < 1.0
    none, _ = push_since(geometry, mean_of(model, free), before)
    assert none == pytest.approx(0.0, abs=1e-9)


def test_a_pull_is_no_push():
    model = UPENN
    before = [mean_of(model, np.zeros(6)) for _ in range(5)]
    push, _ = push_since(PushGeometry(model, TOOL), mean_of(model, pushed(model, -6.0)), before)
    assert push == pytest.approx(-6.0, rel=1e-4)


def test_motors_at_rest_hide_a_push_in_their_friction():
    """7 N of joint 1 at 0.3 m are its Coulomb friction: who stands still says so much less."""
    model = UPENN
    geometry, still = PushGeometry(model, TOOL), np.zeros(6)
    _, moving = push_since(geometry, mean_of(model, still), [mean_of(model, still)] * 5)
    _, resting = push_since(geometry, mean_of(model, still, rate=still), [mean_of(model, still, rate=still)] * 5)
    assert resting > 3 * moving
    _, turned = push_since(geometry, mean_of(model, still, rate=-MOVING), [mean_of(model, still)] * 5)
    assert turned > resting  # friction that has changed its sense


def test_posture_and_noise_add_to_the_deviation():
    model = UPENN
    geometry, still = PushGeometry(model, TOOL), np.zeros(6)
    _, quiet = push_since(geometry, mean_of(model, still), [mean_of(model, still)] * 5)
    _, noisy = push_since(geometry, mean_of(model, still, variance=1.0), [mean_of(model, still, variance=1.0)] * 5)
    elsewhere = [mean_of(model, still, q=Q - 0.3)] * 5
    _, moved = push_since(geometry, mean_of(model, still), elsewhere)
    assert noisy > quiet and moved > 5 * quiet


def test_motors_without_torque_say_nothing():
    model = UPENN
    unknown = np.full(6, np.nan)
    push, sigma = push_since(PushGeometry(model, TOOL), mean_of(model, unknown), [mean_of(model, unknown)] * 5)
    assert push == 0.0 and np.isinf(sigma)
