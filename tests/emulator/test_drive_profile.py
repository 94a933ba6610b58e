"""Trapezoidal profiles from any motion: ends, limits, and slopes by finite differences."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canprobe.emulator.drive_profile import braking, trapezoid

PLACES = st.floats(-1e5, 1e5)
SPEEDS = st.floats(-5e4, 5e4)
RATES = st.floats(1e3, 1e7)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.tuples(PLACES, SPEEDS, PLACES, st.floats(1.0, 5e4), RATES, RATES))
def test_a_profile_is_continuous_and_keeps_the_limits(numbers):
    position, velocity, target, speed, up, down = numbers
    profile = trapezoid(position, velocity, target, speed=speed, acceleration=up, deceleration=down)
    assert profile.at(0.0) == pytest.approx((position, velocity), abs=1e-6)
    assert profile.at(profile.duration_s) == (target, 0.0)
    step = profile.duration_s / 500
    samples = [profile.at(k * step) for k in range(501)]
    for (p, v), (q, w) in pairwise(samples):
        assert abs(w - v) <= max(up, down) * step * (1 + 1e-6) + 1e-3
        assert abs(q - p - step * (v + w) / 2) <= max(up, down) * step**2 / 4 * (1 + 1e-6) + 1e-4
        assert abs(w) <= max(speed, abs(velocity)) * (1 + 1e-6) + 1e-3
    assert samples[-2][0] == pytest.approx(target, abs=down * step**2 / 2 + 1e-3)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(SPEEDS, st.floats(1.0, 1e5), RATES, RATES)
def test_a_way_too_short_for_the_speed_has_the_peak_of_the_textbook(velocity, way, up, down):
    velocity = min(abs(velocity), math.sqrt(2 * down * way))  # it can still stop in time
    profile = trapezoid(0.0, velocity, way, speed=1e9, acceleration=up, deceleration=down)
    peak = math.sqrt((2 * up * down * way + down * velocity**2) / (up + down))
    assert profile.duration_s == pytest.approx((peak - velocity) / up + peak / down, abs=1e-6)
    assert profile.at((peak - velocity) / up)[1] == pytest.approx(peak, rel=1e-6)


@given(PLACES, SPEEDS.filter(lambda v: abs(v) > 1.0), RATES)
@settings(max_examples=100, deadline=None, derandomize=True)
def test_braking_takes_v2_over_2a(position, velocity, rate):
    profile = braking(position, velocity, rate)
    assert profile.end - position == pytest.approx(velocity * abs(velocity) / (2 * rate), abs=1e-6)
    assert profile.duration_s == pytest.approx(abs(velocity) / rate)
    half, speed = profile.at(profile.duration_s / 2)
    assert half - position == pytest.approx(0.75 * (profile.end - position), abs=1e-6)
    assert speed == pytest.approx(velocity / 2)
