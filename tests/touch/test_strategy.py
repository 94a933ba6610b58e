"""Strategies: constant speed along the curve, inside their region, from the origin."""

import math

import numpy as np
import pytest

from canprobe.touch.strategy import PathFollower, make_strategy

SIZES = {"weave": (0.036, 0.009), "circle": (0.02, 0.0), "straight": (0.03, 0.0)}


@pytest.mark.parametrize("name", SIZES)
def test_tangent_is_the_derivative_of_the_point(name):
    strategy = make_strategy(name, *SIZES[name])
    for phase in np.linspace(0.1, 6.0, 17):
        h = 1e-6
        plus, minus = strategy.point(phase + h), strategy.point(phase - h)
        numeric = [(a - b) / (2 * h) for a, b in zip(plus, minus, strict=True)]
        assert strategy.tangent(phase) == pytest.approx(numeric, abs=1e-7)


@pytest.mark.parametrize("name", SIZES)
def test_starts_at_the_origin_and_closes(name):
    strategy = make_strategy(name, *SIZES[name])
    assert strategy.point(0.0) == pytest.approx((0, 0), abs=1e-12)
    assert strategy.point(2 * math.pi) == pytest.approx((0, 0), abs=1e-12)


@pytest.mark.parametrize("name", SIZES)
def test_follower_stays_on_the_curve_at_the_asked_step(name):
    strategy = make_strategy(name, *SIZES[name])
    follower = PathFollower(strategy)
    x = y = 0.0
    step = 25e-3 / 400
    seen = []
    for _ in range(4000):
        hx, hy = follower.step(x, y, step)
        assert math.hypot(hx, hy) == pytest.approx(1.0)
        x, y = x + hx * step, y + hy * step
        seen.append((x, y))
    path = np.array(seen)
    curve = np.array([strategy.point(p) for p in np.linspace(0, 2 * math.pi, 4000)])
    distance = np.min(np.linalg.norm(path[::20, None] - curve[None], axis=2), axis=1)
    assert distance.max() < 0.5e-3
    assert path.min(axis=0) == pytest.approx(curve.min(axis=0), abs=0.7e-3)
    assert path.max(axis=0) == pytest.approx(curve.max(axis=0), abs=0.7e-3)


def test_unknown_strategy_is_refused():
    with pytest.raises(KeyError):
        make_strategy("spiral", 0.01, 0.01)
