"""Rows, columns and taxels that do not measure: found by a few images, named, and interpolated."""

import numpy as np
import pytest

from canprobe.cell.plant.elastic_contact import depth_for_force
from canprobe.cell.plant.taxels import TaxelArray, TaxelConfig
from canprobe.mechanics.touch.image.patch import PatchCalibration, compute_patch
from canprobe.mechanics.touch.image.silent_taxels import LOOK_PERIOD_NS, SilentTaxels
from canprobe.mechanics.touch.pad import Pad

BLUR_PITCH = 0.7
CYLINDER = (27.8, 0.0)


def row(number, columns=range(16)):
    return tuple((number, column) for column in columns)


def images(force, dead=(), uv=(0.3, 0.2), kappa=CYLINDER, *, seed=0, pad=None):
    """Images of the emulated array, one a look: none pressed, force growing over five, then held."""
    pad = pad or Pad()
    array = TaxelArray(TaxelConfig(dead=dead), np.random.default_rng(seed), pad=pad)
    depth = depth_for_force(force, kappa, 0.04, 1.27e8)
    place = uv[0] * pad.pitch_m, uv[1] * pad.pitch_m
    return [array.image(place, depth * min(k / 5, 1.0), kappa, np.eye(2), k * LOOK_PERIOD_NS * 1e-9) for k in range(16)]


def looked_at(shown, window=None, stated=()):
    """The finder after these images, and the number of looks after which it found something."""
    found = None
    finder = SilentTaxels(shown[0].shape, stated, blur_pitch=BLUR_PITCH)
    for k, image in enumerate(shown):
        finder.look(image, window or (0, 0, *image.shape), k * LOOK_PERIOD_NS)
        found = k if found is None and finder.found else found
    return finder, found


def force_of(finder, image, window=None):
    return compute_patch(finder.bridged(image, window or (0, 0, *image.shape))[0], PatchCalibration(), window).force


@pytest.mark.parametrize(
    ("force", "dead", "words"),
    [
        (1.0, row(7), "row 7 of the array reads nothing"),
        (5.0, tuple((place, 8) for place in range(16)), "column 8 of the array reads nothing"),
        (2.0, row(7, (7, 8)), "row 7 of the array reads nothing in columns 7 to 8"),
        (2.0, ((7, 7),), "the taxel in row 7, column 7 of the array reads nothing"),
    ],
)
def test_what_reads_nothing_is_found_named_and_bridged(force, dead, words):
    """Within half a second of contact; the force within 4 %, where it lacked up to a third."""
    whole, broken = images(force), images(force, dead)
    finder, found = looked_at(broken)
    assert found is not None and (found - 1) * LOOK_PERIOD_NS <= 0.5e9
    assert finder.words == words
    true = compute_patch(whole[-1], PatchCalibration()).force
    assert force_of(finder, broken[-1]) == pytest.approx(true, rel=0.04)
    if len(dead) > 2:
        assert compute_patch(broken[-1], PatchCalibration()).force < 0.87 * true


def test_two_dead_rows_and_a_row_at_the_edge_of_the_pad():
    for dead, uv, error in (
        (row(6) + row(7), (0.3, 0.2), 0.03),
        (row(14), (0.0, 6.5), 0.03),
        (row(15), (0.0, 6.5), 0.1),
    ):
        whole, broken = images(2.0, uv=uv), images(2.0, dead, uv)
        finder, _ = looked_at(broken)
        true = compute_patch(whole[-1], PatchCalibration()).force
        assert {f"row {number} of the array reads nothing" for number, _ in dead} == set(finder.words.split("; "))
        assert force_of(finder, broken[-1]) == pytest.approx(true, rel=error)
        assert compute_patch(broken[-1], PatchCalibration()).force < 0.8 * true


@pytest.mark.parametrize("side", [(16, 16), (5, 20)])
def test_nothing_is_found_on_a_whole_array(side):
    """Small patches, large ones, saturated ones, and at the edge of the pad."""
    rng = np.random.default_rng(sum(side))
    pad = Pad(rows=side[0], columns=side[1])
    for seed in range(25):
        bend = np.sort(rng.uniform(-15.0, 80.0, 2))[::-1]
        force = float(np.exp(rng.uniform(np.log(0.2), np.log(40.0))))
        uv = rng.uniform(-0.5, 0.5, 2) * (side[1], side[0])
        shown = images(force, uv=uv, kappa=(float(bend[0]), float(bend[1])), seed=seed, pad=pad)
        finder, found = looked_at(shown)
        assert found is None and finder.words == ""
        assert finder.bridged(shown[-1], (0, 0, *side))[0] is shown[-1]


def test_a_stuck_row_is_found_when_its_neighbours_are_pressed():
    stuck = images(2.0)
    for image in stuck:
        image[7] = 90
    finder, _ = looked_at(stuck)
    assert finder.words == "row 7 of the array reads always the same"
    true = compute_patch(images(2.0)[-1], PatchCalibration()).force
    assert force_of(finder, stuck[-1]) == pytest.approx(true, rel=0.03)
    resting, _ = looked_at(stuck[:1] * 16)
    assert not resting.found, "nothing presses on it"


def test_a_row_that_measures_again_is_taken_for_whole():
    broken, whole = images(2.0, row(7)), images(2.0)
    finder, _ = looked_at(broken + whole)
    assert finder.found == 0 and finder.words == ""
    assert finder.bridged(whole[-1], (0, 0, 16, 16))[0] is whole[-1]


def test_a_window_shows_it_too():
    window = (4, 4, 8, 8)
    broken = images(2.0, row(7))
    for image in broken:
        cut = image[4:12, 4:12].copy()
        image[:] = 0
        image[4:12, 4:12] = cut
    finder, found = looked_at(broken, window)
    assert found is not None and finder.words == "row 7 of the array reads nothing"
    whole = images(2.0)[-1]
    assert force_of(finder, broken[-1], window) == pytest.approx(
        compute_patch(whole, PatchCalibration()).force, rel=0.05
    )


def test_stated_taxels_are_bridged_from_the_first_image_and_not_named():
    image = images(2.0, row(7))[-1]
    finder = SilentTaxels((16, 16), (*row(7), (40, 3)))
    assert finder.found == 0 and finder.words == ""
    true = compute_patch(images(2.0)[-1], PatchCalibration()).force
    assert force_of(finder, image) == pytest.approx(true, rel=0.03)
