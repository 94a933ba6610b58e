"""A surface read from heights presses a ball as the emulated contact of its curvature does."""

import numpy as np
import pytest

from canprobe.cell.plant.elastic_contact import elastic_contact
from canprobe.mechanics.touch.objects import make_object

SPACING, BALL = 5e-4, 0.03
X, Y = np.meshgrid(np.arange(-0.025, 0.0251, SPACING), np.arange(-0.022, 0.0221, SPACING), indexing="ij")
HEIGHTS = {
    "cylinder": np.sqrt(0.036**2 - Y**2) - 0.036,
    "sphere": np.sqrt(0.05**2 - X**2 - Y**2) - 0.05,
    "saddle": -(X**2) / 0.12 + Y**2 / 0.16,
}


@pytest.mark.parametrize("kind", HEIGHTS)
def test_a_smooth_surface_presses_as_its_curvature_does(kind):
    read = make_object("heights", T_base_object=np.eye(4), heights=HEIGHTS[kind], spacing=SPACING, origin=(0, 0))
    for depth in (5e-5, 1e-4, 2e-4):
        centre = (0.0, 0.0, BALL - depth)
        kappa = tuple(read.closest(centre).kappa)
        assert read.squeezed(centre, BALL) == pytest.approx(elastic_contact(depth, kappa, BALL, 1.0).force, rel=0.01)
    assert read.squeezed((0.0, 0.0, 1.001 * BALL), BALL) == 0.0
