"""Moments of an image by hand, and what the pad remembers against the sum over all past places."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from canprobe.mechanics.touch import MomentImage, PatchCalibration
from canprobe.mechanics.touch.image.calibration import Lag
from canprobe.mechanics.touch.image.moments import LEVEL_COUNTS, TIME_CONSTANTS_S, PadMemory
from canprobe.mechanics.touch.image.pad_lag import GAP_S, QUICK_S, SLOW_S, PadLag


def remembered(t, uv):
    """(3,) uu, uv, vv of the way back, each past place with the share of the memory that it filled, all memories."""
    total = np.zeros(3)
    back = uv - uv[-1]
    for tau in TIME_CONSTANTS_S:
        filled = np.exp(-(t[-1] - t[1:]) / tau) - np.exp(-(t[-1] - t[:-1]) / tau)
        total += filled @ np.stack([back[1:, 0] ** 2, back[1:, 0] * back[1:, 1], back[1:, 1] ** 2], axis=1)
    return total


def test_it_is_the_sum_over_past_places():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.004, 0.05, 300))
    uv = 1e-3 * np.cumsum(rng.normal(size=(300, 2)), axis=0)
    memory = PadMemory()
    for i in range(300):
        found = memory.add(t[i], *uv[i])
        if i % 60 == 59:
            assert found == pytest.approx(remembered(t[: i + 1], uv[: i + 1]), rel=1e-9, abs=1e-18)


# The centroid's lag on the pad.

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
    way = 1e-3 * (SLOW_S - QUICK_S)
    assert v == 0.0
    assert u == pytest.approx(math.copysign(LAG.most * way / (way + LAG.reach), speed), rel=0.01)


def test_at_rest_nothing_is_added_and_never_more_than_the_most():
    assert moved(0.0, 1.0) == (0.0, 0.0)
    assert abs(moved(1.0, 2.0)[0]) < LAG.most


def test_noise_of_centroids_is_not_taken_for_a_way():
    """At rest little of it gets into the places; a way far beyond the noise is corrected as before."""
    centroids = 60e-6 * np.random.default_rng(3).normal(size=(2000, 2))
    added = []
    for sigma in (0.0, 60e-6):
        pad = PadLag(LAG)
        out = [pad.step(5e-3 * k, *uv, sigma=sigma) for k, uv in enumerate(centroids.tolist())]
        added.append(np.std(out - centroids))
    assert added[1] < 0.7 * added[0]
    far = []
    for sigma in (0.0, 20e-6):
        pad = PadLag(LAG)
        places = [pad.step(5e-3 * k, 5e-6 * k, 0.0, sigma)[0] for k in range(400)]
        far.append(places[-1] - 5e-6 * 399)
    assert far[1] == pytest.approx(far[0], rel=0.02)


def test_a_new_contact_starts_without_a_past():
    pad = PadLag(LAG)
    pad.step(0.0, 0.0, 0.0)
    pad.step(0.005, 1e-3, 0.0)
    assert pad.step(0.01 + GAP_S, 5e-3, 2e-3) == (5e-3, 2e-3)


# images

PITCH, RADIUS = 1.5875e-3, 0.040


def test_moments_of_an_image_by_hand():
    rng = np.random.default_rng(3)
    image = np.zeros((16, 16), np.uint8)
    image[5:11, 4:12] = rng.integers(0, 120, (6, 8))
    calibration = PatchCalibration()
    sums = np.zeros(6)
    for i in range(16):
        for j in range(16):
            v, u = (i - 7.5) * PITCH, (j - 7.5) * PITCH
            rho = math.hypot(u, v) / RADIUS
            p = max(int(image[i, j]) - LEVEL_COUNTS, 0) * math.sin(rho) / rho
            sums += p * np.array([1.0, u, v, u * u, u * v, v * v])
    _, u, v, uu, uv, vv = sums / sums[0]
    expected = (uu - u * u, uv - u * v, vv - v * v)
    assert MomentImage(calibration).moments(image) == pytest.approx(expected, rel=1e-9)


def test_image_without_an_ellipse_has_no_moments():
    image = np.zeros((16, 16), np.uint8)
    moment_image = MomentImage(PatchCalibration())
    assert moment_image.moments(image) is None
    image[4:9, 4:9] = LEVEL_COUNTS
    assert moment_image.moments(image) is None
    image[6, 6] = 90
    assert moment_image.moments(image) is None  # a point


def test_moments_do_not_jump_where_a_taxel_passes_the_threshold():
    """A blurred patch slides by one pitch: its moments wander by less than three quarters of what a plain cut makes of
    them."""
    fine = (np.arange(16 * 9) + 0.5) / 9 - 8.0
    u, v = np.meshgrid(fine, fine)
    moment_image, plain = MomentImage(PatchCalibration()), MomentImage(PatchCalibration(threshold_counts=1), 0)
    found, jumping = [], []
    for shift in np.linspace(0.0, 1.0, 21):
        field = 130.0 * np.maximum(1.0 - ((u - shift) / 2.55) ** 2 - (v / 3.7) ** 2, 0.0)
        blurred = gaussian_filter(field, 0.65 * 9).reshape(16, 9, 16, 9).mean(axis=(1, 3))
        image = np.rint(blurred).astype(np.uint8)
        image[image < LEVEL_COUNTS] = 0
        found.append(moment_image.moments(image)[0])
        jumping.append(plain.moments(image)[0])
    assert np.ptp(found) / np.mean(found) < 0.75 * np.ptp(jumping) / np.mean(jumping)
    assert np.ptp(found) / np.mean(found) < 0.035
