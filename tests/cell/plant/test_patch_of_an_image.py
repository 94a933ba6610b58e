"""Patch moments against integrals of elliptic patches."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from canprobe.cell.plant.elastic_contact import depth_for_force
from canprobe.cell.plant.taxels import TaxelArray, TaxelConfig
from canprobe.errors import UsageError
from canprobe.fieldbus.protocol.tactile import MAX_SIDE
from canprobe.mechanics.touch.contact import Doubt
from canprobe.mechanics.touch.image.moments import MomentImage
from canprobe.mechanics.touch.image.patch import PatchCalibration, compute_patch, patch_from_features
from canprobe.mechanics.touch.image.silent_taxels import mended
from canprobe.mechanics.touch.pad import Pad

PITCH = 1.5875e-3
EXACT = PatchCalibration(threshold_counts=0)


def press(u0, v0, a, b, angle=0.0, *, peak=80e3, fine=24):
    """Exact taxel means of an elliptic paraboloid of pressure, rounded to counts."""
    k = (np.arange(16 * fine) + 0.5) / fine - 8.0
    V, U = np.meshgrid(k * PITCH, k * PITCH, indexing="ij")
    c, s = math.cos(angle), math.sin(angle)
    x, y = c * (U - u0) + s * (V - v0), -s * (U - u0) + c * (V - v0)
    p = peak * np.maximum(1 - (x / a) ** 2 - (y / b) ** 2, 0)
    return np.round(p.reshape(16, fine, 16, fine).mean(axis=(1, 3)) / 100e3 * 255).astype(np.uint8)


@pytest.mark.parametrize(("u0", "v0", "angle"), [(0, 0, 0), (1.1e-3, -0.7e-3, 0.5), (-2e-3, 3e-3, -1.2)])
def test_moments_of_an_elliptic_patch(u0, v0, angle):
    a, b = 5.8e-3, 4.0e-3
    image = press(u0, v0, a, b, angle)
    patch = compute_patch(image, EXACT)
    assert (patch.u, patch.v) == pytest.approx((u0, v0), abs=0.02e-3)
    assert patch.force == pytest.approx(math.pi * a * b * 80e3 / 2, rel=0.015)
    c, s = math.cos(angle), math.sin(angle)
    wanted = np.array([[c, -s], [s, c]]) @ np.diag([a * a / 6, b * b / 6]) @ np.array([[c, s], [-s, c]])
    uu, uv, vv = MomentImage(EXACT, 0).moments(image)
    got = np.array([[uu, uv], [uv, vv]]) - PITCH**2 / 12 * np.eye(2)  # of the taxels themselves
    assert np.allclose(got, wanted, atol=0.03 * a * a / 6)
    assert patch.good


def test_nothing_there():
    patch = compute_patch(np.full((16, 16), 4, np.uint8), PatchCalibration())
    assert (patch.force, patch.n_active) == (0.0, 0)
    assert math.isnan(patch.u)
    assert patch.too_few and not patch.good


def test_flags():
    image = press(0, 0, 4e-3, 4e-3)
    assert not compute_patch(image, EXACT, (4, 4, 8, 8)).cut_by_window
    assert compute_patch(image, EXACT, (6, 4, 8, 8)).cut_by_window
    assert compute_patch(image, EXACT, (4, 2, 8, 7)).cut_by_window
    edge = compute_patch(press(-11e-3, 0, 4e-3, 4e-3), EXACT, (4, 0, 8, 8))
    assert (edge.cut_by_pad, edge.cut_by_window) == (True, False)
    hot = image.copy()
    hot[7, 7] = 255
    assert compute_patch(hot, EXACT).saturated
    few = np.zeros((16, 16), np.uint8)
    few[7, 7:10] = 50
    assert compute_patch(few, EXACT).too_few
    few[8, 8] = 50
    assert not compute_patch(few, EXACT).too_few


def features_of(image):
    """What a node computes of an image, written out."""
    p = image / 255 * 100e3 * PITCH**2
    row, col = np.mgrid[:16, :16]
    force = p.sum()
    r, q = (p * row).sum() / force, (p * col).sum() / force
    return SimpleNamespace(
        force_n=force,
        row=r,
        col=q,
        var_rr=(p * (row - r) ** 2).sum() / force,
        var_rc=(p * (row - r) * (col - q)).sum() / force,
        var_cc=(p * (col - q) ** 2).sum() / force,
        peak=int(image.max()),
    )


EDGE = 8 * PITCH


@pytest.mark.parametrize(("radius", "towards"), [(3e-3, (1, 0)), (7e-3, (-1, 0)), (5e-3, (0, 1)), (5e-3, (0, -1))])
def test_a_contact_that_runs_off_the_pad_is_told(radius, towards):
    """Not while all of it is on the pad, nor where a hundredth is lost; always from a third on."""
    whole = math.pi * radius**2 * 80e3 / 2
    for place in np.linspace(0.0, EDGE + 0.8 * radius, 20):
        image = press(towards[0] * place, towards[1] * place, radius, radius)
        seen, told = compute_patch(image, EXACT), patch_from_features(features_of(image), EXACT)
        lost = 1.0 - told.force / whole
        if place <= EDGE - radius or lost < 0.01:
            assert not seen.off_pad and not told.off_pad
        elif lost > 0.33:
            assert seen.off_pad and told.off_pad


def test_features_say_the_same_as_the_image():
    image = press(1e-3, -2e-3, 5e-3, 4e-3, 0.4)
    full = compute_patch(image, EXACT)
    features = features_of(image)
    patch = patch_from_features(features, EXACT)
    assert patch.force == pytest.approx(full.force, rel=0.01)  # the node does not know the sphere
    assert (patch.u, patch.v) == pytest.approx((full.u, full.v), abs=0.02e-3)
    assert patch.peak_pa == full.peak_pa
    assert not patch.too_few
    nothing = SimpleNamespace(force_n=0.0, row=0.0, col=0.0, var_rr=0.0, var_rc=0.0, var_cc=0.0, peak=0)
    assert patch_from_features(nothing, EXACT).too_few


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: compute_patch(np.zeros((8, 8), np.uint8), EXACT), "taxels"),
        (lambda: compute_patch(np.zeros((16, 16)), EXACT), "taxels"),
        (lambda: Pad(pitch_m=0.0), "pitch_m"),
        (lambda: PatchCalibration(gains=((1.0, 1.0),)), "gains"),
    ],
)
def test_errors_name_the_field(call, field):
    with pytest.raises(UsageError, match=f"^{field}: expected"):
        call()


# Dead taxels in the patch: found, bridged, told.

TAXEL_PITCH = PatchCalibration().pad.pitch_m


def pressed(u, v, dead=(), kappa=(27.8, 0.0), seed=0):
    """An image of the emulated array at 2 N after a second."""
    array = TaxelArray(TaxelConfig(dead=dead), np.random.default_rng(seed))
    depth = depth_for_force(2.0, kappa, 0.04, 1.27e8)
    for t in (0.0, 0.5, 1.0):
        image = array.image((u * TAXEL_PITCH, v * TAXEL_PITCH), depth, kappa, np.eye(2), t)
    return image


def test_a_whole_patch_is_left_alone():
    for seed in range(10):
        u, v = np.random.default_rng(seed).uniform(-3.0, 3.0, 2)
        image = pressed(u, v, seed=seed)
        whole, dead = mended(image)
        assert whole is image
        assert dead == 0
        assert compute_patch(image, PatchCalibration()).doubts == ()


@pytest.mark.parametrize("place", [(7, 7), (6, 8)])
def test_a_dead_taxel_is_bridged_and_told(place):
    """Centroid within 0.03 of a pitch, force within 2 %; further from the truth where it is left alone."""
    bridged, alone = [], []
    for seed in range(10):
        u, v = np.random.default_rng(seed).uniform(-0.5, 0.5, 2)
        whole = compute_patch(pressed(u, v, seed=seed), PatchCalibration())
        image = pressed(u, v, (place,), seed=seed)
        patch = compute_patch(image, PatchCalibration())
        assert image[place] == 0
        assert patch.dead == 1
        assert not patch.good
        assert patch.doubts == (Doubt.DEAD,)
        bridged.append(np.hypot(patch.u - whole.u, patch.v - whole.v) / TAXEL_PITCH)
        assert patch.force == pytest.approx(whole.force, rel=0.02)
        axis, counts = np.arange(MAX_SIDE) - 7.5, image / image.sum()
        centroid = TAXEL_PITCH * np.array((counts.sum(axis=0) @ axis, counts.sum(axis=1) @ axis))
        alone.append(np.hypot(centroid[0] - whole.u, centroid[1] - whole.v) / TAXEL_PITCH)
    assert max(bridged) < 0.03
    assert np.mean(bridged) < 0.5 * np.mean(alone)


def test_the_mean_of_its_neighbours_is_put_in():
    image = np.zeros((MAX_SIDE, MAX_SIDE), np.uint8)
    image[4:9, 4:9] = 100
    image[5, 6], image[7, 6], image[6, 5], image[6, 7] = 40, 60, 80, 120
    image[6, 6] = 0
    whole, dead = mended(image)
    assert dead == 1
    assert whole[6, 6] == 75
    assert image[6, 6] == 0
    assert np.count_nonzero(whole != image) == 1
