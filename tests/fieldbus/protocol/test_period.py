"""Instants of a free-running device from late, jittered and lost arrivals."""

import math
from random import Random
from statistics import fmean

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.fieldbus.protocol.period import MAX_ARRIVALS, PeriodFit

PERIOD_NS = 10_100_000  # 1 % off the stated 100 Hz
STATED_NS = 10_000_000


def errors_of(jitter_ns, lost=0.0, images=600, seed=1):
    """Errors (s) of the fitted instants and their stated deviations, once the fit is full."""
    rng = Random(seed)
    fit, errors, stated = PeriodFit(STATED_NS), [], []
    for k in range(images):
        late = rng.uniform(-jitter_ns, jitter_ns)
        if rng.random() < lost:
            continue
        t, sigma = fit.step(round(k * PERIOD_NS + late))
        errors.append(1e-9 * (t - k * PERIOD_NS))
        stated.append(sigma)
    assert fit.restarts == 0
    return errors[MAX_ARRIVALS:], stated[MAX_ARRIVALS:], fit


def rms(values):
    return math.sqrt(fmean(value * value for value in values))


@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_jitter_is_averaged_out_and_stated(lost):
    jitter_ns = 500_000
    errors, stated, fit = errors_of(jitter_ns, lost)
    arrivals = 1e-9 * jitter_ns / math.sqrt(3.0)
    assert rms(errors) < arrivals / 3
    # the end of a line through m points has a variance of about 4/m of a point's
    assert fmean(stated) == pytest.approx(arrivals * 2 / math.sqrt(MAX_ARRIVALS), rel=0.1)
    assert 0.7 < rms(errors) / fmean(stated) < 1.4
    assert fit.period_ns == pytest.approx(PERIOD_NS, rel=1e-3)


def test_a_steady_device_is_known_to_the_rounding():
    errors, stated, _ = errors_of(0)
    assert max(map(abs, errors)) < 2e-9 and max(stated) < 2e-9


def test_a_restarted_device_is_fitted_anew():
    fit = PeriodFit(STATED_NS)
    for k in range(100):
        fit.step(k * STATED_NS)
    shifted = 100 * STATED_NS + STATED_NS // 2
    t, sigma = fit.step(shifted)
    assert (t, fit.restarts) == (shifted, 1) and sigma == pytest.approx(1e-9 * STATED_NS / math.sqrt(12))
    for k in range(1, 10):
        t, sigma = fit.step(shifted + k * STATED_NS)
    assert t == shifted + 9 * STATED_NS and sigma < 1e-9


@given(st.lists(st.integers(0, 10**9), max_size=100))
def test_no_arrivals_make_it_fail(steps):
    """Frames of several images may be received at one instant, after a stall."""
    fit, t = PeriodFit(STATED_NS), 0
    for step in steps:
        t += step
        instant, sigma = fit.step(t)
        assert abs(instant - t) <= STATED_NS and 0.0 <= sigma < 1e-9 * STATED_NS
        assert 0.75 * STATED_NS <= fit.period_ns <= 1.25 * STATED_NS
