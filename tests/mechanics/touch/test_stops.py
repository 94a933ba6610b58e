"""A force that does not settle, and one that the array cannot show, are doubted; noise is not."""

import numpy as np
import pytest

from canprobe.mechanics.touch.stops import MIN_REST_SAMPLES, AtRest


def doubt_of(forces, saturated=0.0, target=2.0, felt=True):
    rest = AtRest()
    full = round(saturated * len(forces))
    for i, force in enumerate(forces):
        rest.add(force, i < full)
    return rest.doubt(target, felt)


@pytest.mark.parametrize("swing", [0.5, 0.6])
def test_spread_is_the_standard_deviation(swing):
    forces = 2.0 + swing * np.sin(np.arange(30))
    doubt = doubt_of(forces)
    sigma = float(np.std(forces, ddof=1))
    assert (doubt is None) is (sigma <= 0.4)
    if doubt is not None:
        assert f"± {sigma:.1f} N where 2.0 N" in doubt


def test_a_saturated_array_shows_a_lower_bound_only():
    steady = [2.0] * 40
    assert doubt_of(steady, saturated=0.7, felt=False) is None
    assert doubt_of(steady, saturated=1.0, felt=True) is None
    assert "saturated in 80 % of the samples" in doubt_of(steady, saturated=0.8, felt=False)


def test_a_few_samples_tell_nothing():
    assert doubt_of(([0.0, 4.0] * MIN_REST_SAMPLES)[: MIN_REST_SAMPLES - 1]) is None
    assert doubt_of([0.0, 4.0] * MIN_REST_SAMPLES) is not None


def test_a_force_that_stays_far_below_the_wanted_one_is_doubted_but_for_a_saturated_array():
    assert doubt_of([1.1] * 10) is None
    assert doubt_of([0.4] * 10) == (
        "the force is not reached: 0.4 ± 0.0 N where 2.0 N are wanted; the contact is too stiff for the arm's encoder"
        " counts, or servo.surface_height_hz too high"
    )
    assert doubt_of([0.4] * 10, saturated=0.5) is None
