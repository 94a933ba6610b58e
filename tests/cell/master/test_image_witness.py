"""Whether the images of an array live: what repeats or scatters too little, and what must not trip."""

from types import SimpleNamespace

import numpy as np
import pytest

from canprobe.cell.master.image_witness import FROZEN_NS, QUIET_NS, UNSTATED_NS, ImageWitness

PERIOD_NS = 5_000_000
SIGMA = 20e-6
rng = np.random.default_rng(3)


def look(witness, images, *, speed=5e-3, sigma=SIGMA, pressed=True, highest=130, scatter=SIGMA):
    """Show the images; the first time at which the array counts as dead, ns after the first image, or None."""
    for k, image in enumerate(images):
        t_ns = k * PERIOD_NS
        centre = np.array([speed * t_ns * 1e-9, 0.0, 0.0])
        rolled = 2e-3 - 4e-3 * t_ns * 1e-9 * np.array([1.0, 2.0])  # a centroid that moves on steadily
        u, v = rolled + rng.normal(0.0, scatter, 2) if scatter else (1e-3, 1e-3)
        frame = SimpleNamespace(features=None, taxels=np.array([highest]))
        sample = SimpleNamespace(t_sample_ns=t_ns, image=image, frame=frame)
        witness.look(sample, SimpleNamespace(force=1.0 if pressed else 0.0, u=u, v=v), centre, sigma)
        if witness.dead_since_ns is not None:
            return t_ns
    return None


def test_an_array_that_repeats_its_image_while_the_probe_moves_is_dead():
    assert look(ImageWitness(), [b"same"] * 100, scatter=0.0) == pytest.approx(FROZEN_NS, abs=PERIOD_NS)


@pytest.mark.parametrize("how", [{"speed": 0.0}, {"pressed": False}])
def test_at_rest_or_without_a_contact_it_may_repeat_itself(how):
    assert look(ImageWitness(), [b"same"] * 100, scatter=0.0, **how) is None


@pytest.mark.parametrize(("speed", "highest", "dead"), [(10e-3, 130, True), (1e-3, 130, False), (10e-3, 30, False)])
def test_a_coarse_array_does_not_trip(speed, highest, dead):
    found = look(ImageWitness(), [b"same"] * 150, sigma=None, speed=speed, highest=highest)
    assert (found is not None and found >= UNSTATED_NS) if dead else found is None


def test_images_that_differ_and_hardly_scatter_are_dead_too():
    """One dithering count is no noise of forty taxels."""
    found = look(ImageWitness(), range(200), scatter=0.02 * SIGMA)
    assert found is not None and found >= QUIET_NS


@pytest.mark.parametrize("share", [0.3, 1.0, 3.0])
def test_noise_that_is_not_quite_the_stated_one_is_none(share):
    assert look(ImageWitness(), range(2000), scatter=share * SIGMA) is None


def test_a_change_ends_it():
    witness = ImageWitness()
    assert look(witness, [b"same"] * 20, scatter=0.0) is not None
    look(witness, [b"other"], scatter=0.0)
    assert witness.dead_since_ns is None
