"""A motion from rest to rest keeps its limits, arrives, and brakes from wherever it is."""

import random

import numpy as np
import pytest

from canprobe.mechanics.robot.motion_profile import MotionProfile


def drawn(seed):
    rng = random.Random(seed)
    return [10 ** rng.uniform(-3, 2) for _ in range(4)], rng.random()


def states(profile, count=2000):
    times = np.linspace(0.0, profile.duration_s, count)
    return times, *np.array([profile.at(t) for t in times]).T


@pytest.mark.parametrize("seed", range(20))
def test_limits_are_kept_and_the_end_is_reached_at_rest(seed):
    (length, speed, acceleration, jerk), share = drawn(seed)
    profile = MotionProfile(length, speed, acceleration, jerk)
    for braked in (False, True):
        t, s, v = states(profile)
        a = np.diff(v) / np.diff(t)
        assert v.min() >= -1e-9 * speed and v.max() <= speed * (1 + 1e-9)
        assert np.abs(a).max() <= acceleration * (1 + 1e-6)
        assert np.abs(np.diff(a)).max() <= jerk * (t[1] - t[0]) * 1.01 + 1e-6 * acceleration
        assert v[-1] == pytest.approx(0.0, abs=1e-7 * speed)
        if not braked:
            assert s[-1] == pytest.approx(length, rel=1e-9)
            begin = share * profile.duration_s
            place, before_s = profile.at(begin)[0], profile.duration_s
            profile.brake(begin)
        else:
            assert place - 1e-9 <= s[-1] <= length * (1 + 1e-9) and profile.duration_s <= before_s * (1 + 1e-9)


def test_it_is_as_quick_as_the_limits_allow():
    """By hand: 0.1 s of jerk up to 1/s², 0.4 s at it, 0.1 s down: 0.5/s; the same back; the rest at that speed."""
    profile = MotionProfile(1.0, 0.5, 1.0, 10.0)
    assert profile.duration_s == pytest.approx(2 * 0.6 + (1.0 - 0.5 * 0.6) / 0.5)
    assert profile.at(0.6) == pytest.approx((0.15, 0.5))
    assert MotionProfile(0.0, 1.0, 1.0, 1.0).duration_s == 0.0
