"""Stretches are smooth paths of the stated length, and the room keeps them inside with a way on."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.mechanics.touch.explore.stretches import Heading, Room, Stretch, WalkedBack, fan

RADIUS = 2e-3


@given(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.floats(-3.0, 3.0), st.floats(-4.0, 4.0), st.floats(0.0, 0.02))
def test_the_direction_is_the_derivative_of_the_place(x, y, angle, turn, straight):
    stretch = Stretch(Heading(x, y, angle), turn, RADIUS, straight)
    assert stretch.point(0.0) == pytest.approx((x, y), abs=1e-12)
    for way in np.linspace(1e-4, max(stretch.length - 1e-4, 2e-4), 7):
        step = np.subtract(stretch.point(way + 1e-7), stretch.point(way - 1e-7)) / 2e-7
        assert step == pytest.approx(stretch.tangent(way), abs=1e-3)
    half = stretch.cut(0.5 * stretch.length)
    assert half.length == pytest.approx(0.5 * stretch.length)
    assert half.point(half.length) == pytest.approx(stretch.point(half.length), abs=1e-12)


@given(st.floats(-0.015, 0.015), st.floats(-0.015, 0.015), st.floats(-3.0, 3.0))
def test_the_first_stretches_of_a_fan_lead_to_the_target(x, y, angle):
    start = Heading(0.0, 0.0, angle)
    leading = [stretch for stretch in fan(start, RADIUS, (x, y)) if stretch.straight != 24e-3]
    assert leading or math.hypot(x, y) <= 2.0 * RADIUS
    for stretch in leading:
        assert stretch.point(stretch.length) == pytest.approx((x, y), abs=1e-9)


def test_what_is_left_of_a_stretch_is_inside_and_can_turn():
    room = Room((0.03, 0.02), RADIUS)
    room.close(np.array([[0.01, 0.0]]), 2e-3)
    rng = np.random.default_rng(1)
    went = 0
    for _ in range(25):
        start = Heading(*rng.uniform((-0.013, -0.008), (0.013, 0.008)), rng.uniform(-3, 3))
        for stretch in fan(start, RADIUS, (-0.01, 0.005)):
            reach = room.reach(stretch)
            went += reach > 0.0
            for way in np.arange(1e-3, reach + 1e-9, 1e-3):
                x, y = stretch.point(way)
                assert abs(x) < 0.0151
                assert abs(y) < 0.0101
                assert math.hypot(x - 0.01, y) > 1.99e-3
            if reach:
                on = room.circle(stretch.at(reach))
                turn = np.array([on.point(way) for way in np.linspace(0.0, on.length, 50)])
                assert room.inside(turn, -1e-6).all()
    assert went > 100


def test_the_way_back_is_the_way_that_was_walked():
    walked = [(1e-3 * k, 1e-3 * k * k / 10) for k in range(8)]
    back = WalkedBack(walked)
    assert back.point(0.0) == pytest.approx(walked[-1])
    assert back.point(back.length) == pytest.approx(walked[0])
    assert back.tangent(0.0)[0] < 0.0
    assert back.length == pytest.approx(sum(math.dist(a, b) for a, b in itertools.pairwise(walked)))
