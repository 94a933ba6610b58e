"""Dead taxels in the patch: found, bridged, told."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.emulator.plant.contact import depth_for_force
from canprobe.emulator.plant.taxels import TaxelArray, TaxelConfig
from canprobe.touch.contact import Doubt
from canprobe.touch.patch import SIDE, PatchCalibration, compute_patch
from canprobe.touch.patch_mending import mended

PITCH = PatchCalibration().pitch_m


def pressed(u, v, dead=(), kappa=(27.8, 0.0), seed=0):
    """An image of the emulated array at 2 N after a second."""
    array = TaxelArray(TaxelConfig(dead=dead), np.random.default_rng(seed))
    depth = depth_for_force(2.0, kappa, 0.04, 1.27e8)
    for t in (0.0, 0.5, 1.0):
        image = array.image((u * PITCH, v * PITCH), depth, kappa, np.eye(2), t)
    return image


def test_a_whole_patch_is_left_alone():
    for seed in range(40):
        u, v = np.random.default_rng(seed).uniform(-3.0, 3.0, 2)
        image = pressed(u, v, seed=seed)
        whole, dead = mended(image)
        assert whole is image
        assert dead == 0
        assert compute_patch(image, PatchCalibration()).doubts == ()


@pytest.mark.parametrize("place", [(7, 7), (8, 7), (9, 7), (6, 8)])
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
        bridged.append(np.hypot(patch.u - whole.u, patch.v - whole.v) / PITCH)
        assert patch.force == pytest.approx(whole.force, rel=0.02)
        axis = np.arange(SIDE) - 7.5
        counts = image / image.sum()
        alone.append(np.hypot(counts.sum(axis=0) @ axis - whole.u / PITCH, counts.sum(axis=1) @ axis - whole.v / PITCH))
        assert image.sum() < 0.98 * pressed(u, v, seed=seed).sum()
    assert max(bridged) < 0.03
    assert np.mean(bridged) < 0.5 * np.mean(alone)


def test_the_mean_of_its_neighbours_is_put_in():
    image = np.zeros((SIDE, SIDE), np.uint8)
    image[4:9, 4:9] = 100
    image[5, 6], image[7, 6], image[6, 5], image[6, 7] = 40, 60, 80, 120
    image[6, 6] = 0
    whole, dead = mended(image)
    assert dead == 1
    assert whole[6, 6] == 75
    assert image[6, 6] == 0
    assert np.array_equal(np.delete(whole.reshape(-1), 6 * SIDE + 6), np.delete(image.reshape(-1), 6 * SIDE + 6))
