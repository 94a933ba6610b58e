"""A patch that the window cuts: what is outside is carried on from what is inside."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.cell.emulated.array import follow, middle
from canprobe.cell.planning.array import CARRIED_ERROR, CARRIED_SHARE, CARRIED_SIDE, measured_share
from canprobe.cell.plant.elastic_contact import depth_for_force
from canprobe.cell.plant.taxels import TaxelArray, TaxelConfig
from canprobe.cell.scene.setup import Probe
from canprobe.fieldbus.protocol.tactile import MAX_SIDE
from canprobe.mechanics.touch.image.patch import Continuation, PatchCalibration, compute_patch

EXACT = PatchCalibration()
PITCH = EXACT.pad.pitch_m
FULL_PA = 100e3
SOFT = 2.3e7  # N/m³: 4 kN/m at 2 N on the cylinder
CYLINDER = (1 / 0.036, 0.0)


def paraboloid(u=0.4, v=-0.3, half=(4.5, 7.0), turn=0.5, peak=60e3):
    """Pressure (16, 16) in Pa of an elliptic patch: middle and half-axes in pitches."""
    k = np.arange(MAX_SIDE) - 7.5
    x, y = np.meshgrid(k - u, k - v)
    along, across = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
    return peak * np.maximum(1.0 - (along / half[0]) ** 2 - (across / half[1]) ** 2, 0.0)


def seen(image, window):
    """What a window shows of an image."""
    r, c, rows, cols = window
    shown = np.zeros_like(image)
    shown[r : r + rows, c : c + cols] = image[r : r + rows, c : c + cols]
    return shown


def completed(pressure, window):
    """With the highest pressure there is, as the patch knows it."""
    return Continuation(EXACT.weights, FULL_PA).completed(pressure, window, float(pressure.max()))


@pytest.mark.parametrize("window", [(5, 3, 8, 8), (6, 5, 6, 6)])
def test_a_quadratic_is_carried_on_exactly(window):
    whole = paraboloid()
    assert seen(whole, window).sum() < 0.99 * whole.sum()
    np.testing.assert_allclose(completed(seen(whole, window), window), whole, atol=1e-6 * FULL_PA)


def test_saturated_taxels_do_not_flatten_it():
    whole, window = paraboloid(peak=130e3), (4, 4, 8, 8)
    found = completed(seen(np.minimum(whole, FULL_PA), window), window)
    outside = seen(np.ones_like(whole), window) == 0.0
    np.testing.assert_allclose(found[outside], whole[outside], atol=1e-6 * FULL_PA)
    assert found[~outside].max() == FULL_PA, "what was seen stays"


@pytest.mark.parametrize(
    "pressure",
    [
        np.zeros((MAX_SIDE, MAX_SIDE)),
        seen(np.full((MAX_SIDE, MAX_SIDE), 5e4), (4, 4, 8, 8)),  # no summit
        seen(paraboloid(half=(2.0, 1.5)), (4, 4, 8, 8)),  # too few taxels
        seen(1e5 - paraboloid(), (4, 4, 8, 8)),  # a pit
        np.eye(MAX_SIDE) * 5e4,  # all in one line
    ],
)
def test_what_is_no_patch_is_left_alone(pressure):
    assert completed(pressure, (4, 4, 8, 8)) is pressure


def test_a_patch_that_the_window_holds_is_the_same_with_and_without_it():
    counts = np.rint(paraboloid(half=(3.0, 2.5)) / FULL_PA * 255).astype(np.uint8)
    assert compute_patch(counts, EXACT, (4, 4, 8, 8)) == compute_patch(counts, EXACT)


def test_force_and_centroid_of_a_soft_contact():
    """The emulated array, 2 N at 4 kN/m, its window as it follows the contact; the truth is the whole image's."""
    depth = depth_for_force(2.0, CYLINDER, EXACT.pad.radius_m, SOFT)
    force, cut, off, cut_off = [], [], [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        array = TaxelArray(TaxelConfig(), rng, stiffness_n_m3=SOFT)
        turn, (u, v) = rng.uniform(0.0, np.pi), rng.uniform(-2.0, 2.0, 2) * PITCH
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        origin = middle()
        for t in np.arange(0.0, 1.0, 0.1):
            way = 1e-3 * np.sin(3.0 * t)
            image = array.image((u + way, v - way), depth * min(1.0, 2.0 * t), CYLINDER, axes, float(t))
            origin = follow(image.astype(float), origin)
        window = (*origin, 8, 8)
        whole, patch = compute_patch(image, EXACT), compute_patch(seen(image, window), EXACT, window)
        left = compute_patch(seen(image, window), EXACT)
        assert patch.cut_by_window and not patch.good
        force.append(patch.force / whole.force - 1.0)
        cut.append(left.force / whole.force - 1.0)
        off.append(np.hypot(patch.u - whole.u, patch.v - whole.v))
        cut_off.append(np.hypot(left.u - whole.u, left.v - whole.v))
    assert np.abs(force).max() < 0.05
    assert abs(np.mean(force)) < 0.025
    assert np.mean(cut) < -0.03
    assert np.max(off) < 0.2e-3
    assert np.mean(off) < 0.5 * np.mean(cut_off)


@pytest.mark.parametrize(("side", "stiffness"), [(6, 2.3e7), (6, 1.27e8), (8, 1.27e7), (10, 1.27e7)])
def test_what_the_plan_says_of_a_window_that_cuts(side, stiffness):
    """2 N on a plane, against the whole image: within the share that `cut_patch` tells."""
    probe = Probe(np.eye(4), EXACT.pad.radius_m, stiffness, 0.3)
    assert measured_share(2.0, probe, side, PITCH) >= CARRIED_SHARE and side >= CARRIED_SIDE
    depth = depth_for_force(2.0, (0.0, 0.0), EXACT.pad.radius_m, stiffness)
    for seed in range(6):
        rng = np.random.default_rng(seed)
        array = TaxelArray(TaxelConfig(), rng, stiffness_n_m3=stiffness)
        image = array.image(tuple(rng.uniform(-2.0, 2.0, 2) * PITCH), depth, (0.0, 0.0), np.eye(2), 0.0)
        window = (*around(image, side), side, side)
        patch = compute_patch(seen(image, window), EXACT, window)
        assert abs(patch.force / compute_patch(image, EXACT).force - 1.0) < CARRIED_ERROR


def around(image, side):
    """First row and column of the window that has the centroid in its middle."""
    places = np.indices(image.shape).reshape(2, -1) @ image.reshape(-1).astype(float) / image.sum()
    return [int(np.clip(round(place - (side - 1) / 2), 0, MAX_SIDE - side)) for place in places]


def test_what_an_array_remembers_is_not_made_larger():
    """After a long press few taxels are above the threshold, in whole counts and noise: no summit that can be seen."""
    array, origin = TaxelArray(TaxelConfig(), np.random.default_rng(0)), middle()
    for t_s in np.arange(0.0, 3.0, 0.05):
        array.image((0.0, 0.0), depth_for_force(4.5, CYLINDER, 0.04, 1.27e8), CYLINDER, np.eye(2), t_s)
    for t_s in np.arange(3.2, 5.0, 0.005):
        image = array.image((0.0, 0.0), -1.0, CYLINDER, np.eye(2), t_s)
        origin = follow(image, origin)
        window = (*origin, 8, 8)
        assert compute_patch(seen(image, window), EXACT, window).force <= 1.2 * compute_patch(image, EXACT).force
