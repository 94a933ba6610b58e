"""Covariances follow the innovations, against errors over many repetitions."""

import math

import numpy as np
import pytest

from canprobe.mechanics.touch import ContactSample, NoiseLevel, OnlineEstimator, make_estimator
from canprobe.mechanics.touch.online.noise_level import MIN_LEVEL

RADIUS, MEMORY = 0.05, 0.02
T = np.eye(4)


def levelled(method, stated, level):
    motion = make_estimator(
        method, sigma_point=2e-5 * stated, sigma_normal=2e-3 * stated, memory_m=MEMORY, window=160, prior=None
    )
    return OnlineEstimator(motion, level)


def scanned(one, rng, path=0.08, step=1.25e-4):
    """Feed a weave over a sphere of radius 50 mm with noise of 20 µm and 2 mrad, an answer for each 2.5 mm."""
    found = []
    for i, s in enumerate(np.arange(-path / 2, path / 2, step)):
        a, b = s / RADIUS, 0.08 * math.sin(s / 2e-3)
        n = np.array([math.sin(a), math.cos(a) * math.sin(b), math.cos(a) * math.cos(b)])
        tilted = n + 2e-3 * rng.standard_normal(3)
        p = RADIUS * n + 2e-5 * rng.standard_normal(3)
        one.add(ContactSample(5e-3 * i, p, tilted / np.linalg.norm(tilted), T, T[:3, 2], 1.0))
        if i % 20 == 19:
            found.append(one.estimate())
    return found


@pytest.mark.parametrize(("method", "stated"), [("recursive", 0.5), ("ml", 1.3)])
def test_a_noise_that_is_stated_wrongly_is_set_right(method, stated):
    rng, squares = np.random.default_rng(3), []
    for _ in range(10):
        answer = scanned(levelled(method, stated, NoiseLevel(MEMORY)), rng, path=0.04)[-1]
        off = (answer.K - np.eye(2) / RADIUS)[[0, 0, 1], [0, 1, 1]]
        squares.append(off @ np.linalg.solve(answer.covariance, off) / 3.0)
    assert 0.6 < np.mean(squares) < 1.8  # 30 degrees of freedom: 0.56 to 1.57 in 95 %; stated are 4 and 0.6


def test_it_begins_at_what_is_stated_and_keeps_a_half():
    one = levelled("recursive", 5.0, level := NoiseLevel(MEMORY))
    answers = scanned(one, np.random.default_rng(0))
    assert level.level == MIN_LEVEL
    plain = make_estimator("recursive", sigma_point=1e-4, sigma_normal=1e-2, memory_m=MEMORY, window=160)
    without = scanned(plain, np.random.default_rng(0))
    ratio = [a.covariance[0, 0] / b.covariance[0, 0] for a, b in zip(answers, without, strict=True) if b.rank == 3]
    assert ratio[0] > 0.8
    assert ratio[-1] == pytest.approx(MIN_LEVEL)
    np.testing.assert_array_equal(answers[-1].K, without[-1].K)
    one.reset()
    assert level.level == 1.0
    assert one.estimate() is None
