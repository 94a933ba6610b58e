"""The blur of an array by its images, against emulated arrays of known blur."""

import math

import numpy as np
import pytest

from canprobe.cell.plant.elastic_contact import depth_for_force
from canprobe.cell.plant.taxels import TaxelArray, TaxelConfig
from canprobe.mechanics.touch.array_calibration.blur_fit import fit_blur
from canprobe.mechanics.touch.pad import Pad

PACKAGED_BLUR, CROSSTALK, WINDOW = 0.72, 0.025, (0, 0, 16, 16)


def found_blur(image, window=WINDOW):
    found = fit_blur(image, window, blur=PACKAGED_BLUR, crosstalk=CROSSTALK, gains=np.ones((16, 16)))
    return None if found is None else found.blur


@pytest.mark.parametrize(("blur", "kappa"), [(0.45, (0.0, 0.0)), (0.65, (40.0, 40.0)), (0.85, (20.0, -10.0))])
def test_the_blur_is_found_whatever_is_touched(blur, kappa):
    """A taxel is a pitch wide, which adds 1/12 to the variance; gains of ±5 % cost some percent."""
    config = TaxelConfig(blur_pitch=blur).without("hysteresis", "creep")  # which smear what jumps to and fro
    array = TaxelArray(config, np.random.default_rng(1))
    depth, pitch = depth_for_force(2.0, kappa, 0.04, 1.27e8), Pad().pitch_m
    places = np.random.default_rng(2).uniform(-0.6, 0.6, (12, 2)) * pitch
    images = [array.image(tuple(uv), depth, kappa, np.eye(2), 0.05 * k) for k, uv in enumerate(places)]
    expected = math.hypot(blur, 1.0 / math.sqrt(12.0))
    found = [blur for blur in map(found_blur, images) if blur is not None]
    assert len(found) >= 6
    assert np.median(found) == pytest.approx(expected, rel=0.05)


def test_an_image_without_a_patch_shows_none():
    line, few = np.zeros((2, 16, 16), np.uint8)
    line[7:9] = 120  # an edge over the whole pad: no paraboloid
    few[7:9, 7:9] = 30
    assert found_blur(np.zeros((16, 16), np.uint8)) is found_blur(few) is found_blur(line) is None


def test_a_window_that_cuts_the_patch_shows_the_same():
    array = TaxelArray(TaxelConfig(), np.random.default_rng(1))
    image = array.image((0.0, 0.0), depth_for_force(3.0, (0.0, 0.0), 0.04, 1.27e8), (0.0, 0.0), np.eye(2), 0.0)
    cut = np.zeros_like(image)
    cut[4:12, 5:11] = image[4:12, 5:11]
    assert found_blur(cut, (4, 5, 8, 6)) == pytest.approx(found_blur(image), rel=0.1)
