"""Stretches are smooth paths of the stated length, and the room keeps them inside with a way on."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from canprobe.mechanics.touch.explore.stretches import Heading, Room, Stretch, WalkedBack, leading_to, stretches_to

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


PLACES = st.builds(Heading, st.floats(-0.015, 0.015), st.floats(-0.015, 0.015), st.floats(-3.0, 3.0))


@example(Heading(0.0, 0.0, 0.0), Heading(0.0, 6e-8, 0.0))
@given(PLACES, PLACES)
def test_smooth_paths_lead_from_one_place_and_direction_to_another(start, end):
    paths = stretches_to(start, end, RADIUS, 5e-3)
    assert len(paths) >= 2
    for first, second in paths:
        assert first.start == start
        assert second.start == pytest.approx(first.at(first.length), abs=1e-9)
        assert second.at(second.length - 5e-3)[:2] == pytest.approx(end[:2], abs=1e-8)
        assert math.cos(second.at(second.length).angle - end.angle) == pytest.approx(1.0, abs=1e-9)
    lengths = [first.length + second.length for first, second in paths]
    assert lengths == sorted(lengths)
    assert lengths[0] >= math.dist(start[:2], end[:2]) + 5e-3 - 1e-9


@given(PLACES, st.sampled_from([1.0, -1.0]), st.floats(-0.015, 0.015), st.floats(-0.015, 0.015))
def test_a_turn_and_a_line_lead_to_a_place_outside_the_circle(start, side, x, y):
    way = leading_to(start, side, RADIUS, (x, y))
    if way is None:
        assert math.dist(start.centre(RADIUS, side), (x, y)) <= RADIUS
    else:
        assert way.point(way.length) == pytest.approx((x, y), abs=1e-8)


def test_what_is_left_of_a_stretch_is_inside_and_can_turn():
    room = Room((0.03, 0.02), RADIUS)
    room.closed = np.array([[0.01, 0.0]])
    rng = np.random.default_rng(1)
    went = 0
    for _ in range(25):
        start = Heading(*rng.uniform((-0.013, -0.008), (0.013, 0.008)), rng.uniform(-3, 3))
        for turn, factor in itertools.product((-2.6, -0.8, 0.0, 0.8, 2.6), (1.0, 3.0)):
            stretch = Stretch(start, turn, factor * RADIUS, 24e-3)
            reach = room.reach(stretch)
            went += reach > 0.0
            for way in stretch.ways()[stretch.ways() <= reach].tolist():
                x, y = stretch.point(way)
                assert abs(x) < 0.0151
                assert abs(y) < 0.0101
                assert math.hypot(x - 0.01, y) > 1.99e-3
            if reach:
                on = room.circle(stretch.at(reach))
                full = np.array([on.point(way) for way in np.linspace(0.0, on.length, 50)])
                assert room.inside(full, -1e-6).all()
    assert went > 100


def test_the_way_back_is_the_way_that_was_walked():
    walked = [(1e-3 * k, 1e-3 * k * k / 10) for k in range(8)]
    back = WalkedBack(walked)
    assert back.point(0.0) == pytest.approx(walked[-1])
    assert back.point(back.length) == pytest.approx(walked[0])
    assert back.tangent(0.0)[0] < 0.0
    assert back.length == pytest.approx(sum(math.dist(a, b) for a, b in itertools.pairwise(walked)))
