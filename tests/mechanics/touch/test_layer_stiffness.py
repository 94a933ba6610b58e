"""The layer's stiffness from a touch, against the elastic law written out."""

import math

import numpy as np
import pytest

from canprobe.mechanics.touch import indentation_from_force
from canprobe.mechanics.touch.layer_stiffness import MIN_PUSH_SAMPLES, PushFit, stiffness_from_slope

RADIUS = 0.04


def force_at(depth, stiffness, kappa):
    a, b = (0.5 * (1 / RADIUS + k) for k in kappa)
    return math.pi * stiffness * depth**2 / (2 * math.sqrt(a * b))


def pushed(stiffness, kappa, depths, *, zero=0.0, noise=None):
    fit = PushFit()
    for i, depth in enumerate(depths):
        force = force_at(depth, stiffness, kappa)
        fit.add(zero + depth, force if noise is None else max(force * (1 + noise[i]), 0.0))
    return fit


@pytest.mark.parametrize("kappa", [(1 / 0.036, 0.0), (20.0, -12.0)])
@pytest.mark.parametrize("stiffness", [2.3e7, 2.3e9])
def test_the_stiffness_that_made_the_force_is_found_whatever_the_zero(stiffness, kappa):
    deepest = indentation_from_force(2.0, stiffness, RADIUS, kappa)
    fit = pushed(stiffness, kappa, np.linspace(0.3, 1.0, 40) * deepest, zero=-0.2)
    assert fit.certain(0.1)
    assert fit.slope == pytest.approx(math.sqrt(2.0) / deepest, rel=1e-9)
    assert fit.start == pytest.approx(-0.2, abs=1e-9 * deepest)
    assert stiffness_from_slope(fit.slope, RADIUS, kappa) == pytest.approx(stiffness, rel=1e-8)


def test_pulling_counted_as_pushing_gives_no_stiffness():
    fit = PushFit()
    for depth in np.linspace(0.1e-3, 0.4e-3, 40):
        fit.add(-depth, force_at(depth, 1.27e8, (0.0, 0.0)))
    assert fit.slope < 0
    assert not fit.certain(0.5)


def test_too_little_is_not_certain():
    depths = np.linspace(0.2e-3, 0.4e-3, MIN_PUSH_SAMPLES - 1)
    few = pushed(1.27e8, (0.0, 0.0), depths)
    assert math.isnan(few.slope) and few.sigma == math.inf and not few.certain(0.5)
    still = pushed(1.27e8, (0.0, 0.0), np.full(50, 0.3e-3))
    assert not still.certain(0.5)
    weak = pushed(1.27e8, (0.0, 0.0), np.linspace(0.0, 0.05e-3, 50))  # below the least force
    assert math.isnan(weak.slope)
    fit = PushFit()
    fit.add(math.nan, 1.0)
    fit.add(1e-3, math.nan)
    assert fit.sigma == math.inf


@pytest.mark.parametrize("push_sigma", [0.0, 9e-6])
def test_nonsense_has_a_slope_and_is_not_believed(push_sigma):
    rng, fit = np.random.default_rng(3), PushFit(push_sigma)
    for depth in np.linspace(0.1e-3, 0.5e-3, 100):
        fit.add(depth, rng.uniform(0.1, 6.0))
    assert fit.sigma < math.inf and fit.scatter > 0.3
    assert not fit.certain(10.0)


def test_a_stiff_touch_is_believed_as_far_as_the_encoders_tell_the_push():
    """Rounded to counts of 30 µm, the push of a 40 kN/m touch is off by half a newton: less certain, no nonsense."""
    rng = np.random.default_rng(5)
    stiffness, sigma = 18 * 1.27e8, 30e-6 / math.sqrt(12.0)
    depths = np.tile(np.linspace(0.03e-3, 0.1e-3, 30), 3)
    fits = PushFit(), PushFit(push_sigma=sigma)
    for depth in depths:
        force = force_at(depth, stiffness, (1 / 0.036, 0.0))
        measured = depth + rng.uniform(-15e-6, 15e-6)
        for fit in fits:
            fit.add(measured, force)
    exact, rounded = fits
    assert exact.slope == rounded.slope and exact.sigma < rounded.sigma / 3
    assert not exact.certain(0.12) and rounded.certain(0.12)
    true = math.sqrt(force_at(1.0, stiffness, (1 / 0.036, 0.0)))
    flatter = 1.0 / (1.0 + sigma**2 / np.var(depths))
    assert rounded.slope == pytest.approx(flatter * true, rel=0.05)


def test_its_standard_deviation_covers_a_force_known_to_six_percent():
    depths = np.linspace(0.15e-3, 0.42e-3, 60)
    true = pushed(1.27e8, (0.0, 0.0), depths).slope
    errors = []
    for seed in range(200):
        noise = 0.06 * np.random.default_rng(seed).standard_normal(len(depths))
        fit = pushed(1.27e8, (0.0, 0.0), depths, noise=noise)
        errors.append((fit.slope - true) / fit.sigma)
    assert 0.6 < np.std(errors) < 1.3
    assert abs(np.mean(errors)) < 0.3
