"""The centroid's lag on the pad."""

from __future__ import annotations

import math

import numpy as np
import pytest

from canprobe.touch.pad_lag import GAP_S, Lag, PadLag

LAG = Lag(most=120e-6, reach=200e-6)


def moved(speed, seconds, rate=200.0):
    """What is added to the centroid of a contact that goes along u at a speed (m/s), at the end."""
    pad = PadLag(LAG)
    for k in range(round(seconds * rate)):
        u = speed * k / rate
        out = pad.step(k / rate, u, 1e-3)
    return out[0] - u, out[1] - 1e-3


@pytest.mark.parametrize("speed", [1e-3, -1e-3])
def test_a_contact_is_ahead_of_its_centroid(speed):
    """Means of time constants T trail a steady motion by speed · T."""
    u, v = moved(speed, 3.0)
    way = 1e-3 * (LAG.slow_s - LAG.quick_s)
    assert v == 0.0
    assert u == pytest.approx(math.copysign(LAG.most * way / (way + LAG.reach), speed), rel=0.01)


def test_at_rest_nothing_is_added_and_never_more_than_the_most():
    assert moved(0.0, 1.0) == (0.0, 0.0)
    assert abs(moved(1.0, 2.0)[0]) < LAG.most


def test_it_comes_close_to_a_pad_with_play():
    """A centroid that a loop of 60 µm drags behind on a weave: most of the lag is gone, whatever the phase."""
    t = np.arange(0.0, 6.0, 0.005)
    true = 0.45e-3 * np.stack([np.sin(1.6 * t), np.cos(1.0 * t)], axis=1)
    pad, centre, left, before = PadLag(LAG), true[0].copy(), [], []
    for k, place in enumerate(true):
        way = place - centre
        size = float(np.hypot(*way))
        centre = centre + way * max(0.0, 1.0 - 60e-6 / max(size, 1e-12))
        out = pad.step(float(t[k]), *centre.tolist())
        left.append(out - place)
        before.append(centre - place)
    assert np.std(left[200:]) < 0.65 * np.std(before[200:])


def test_a_new_contact_starts_without_a_past():
    pad = PadLag(LAG)
    pad.step(0.0, 0.0, 0.0)
    pad.step(0.005, 1e-3, 0.0)
    assert pad.step(0.01 + GAP_S, 5e-3, 2e-3) == (5e-3, 2e-3)
