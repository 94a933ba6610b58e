"""A floor and boxes against the links of an arm and its probe, with distances by hand."""

import numpy as np
import pytest

from canprobe.mechanics.robot.denavit_hartenberg import from_dh
from canprobe.mechanics.robot.keep_out import KeepOut

ARM = from_dh([(0.0, np.pi / 2, 0.5, 0.0), (1.0, 0.0, 0.0, 0.0)], "standard", name="two", joints=["a", "b"])
"""A column of 0.5 m, and a link of 1 m that swings in the vertical plane of x."""
NOTHING = np.zeros((0, 2, 3))


@pytest.mark.parametrize(("degrees", "touches"), [(0, None), (-25, None), (-30, "the floor is at 0 mm")])
def test_a_link_keeps_its_radius_above_the_floor(degrees, touches):
    """The end of the link is 0.5 m - sin of its angle above the floor: at -25° 77 mm, at -30° 0 mm."""
    keep_out = KeepOut(0.0, NOTHING, 0.05, np.zeros(3), 0.05)
    said = keep_out.touched(ARM, np.radians([0.0, degrees]))
    assert said is None if touches is None else touches in said


def test_the_middle_of_a_link_does_not_pass_through_a_box_between_its_ends():
    box = np.array([[[0.45, -0.02, 0.4], [0.55, 0.02, 0.46]]])
    keep_out = KeepOut(-np.inf, box, 0.05, np.zeros(3), 0.05)
    assert keep_out.touched(ARM, np.zeros(2)) == "the link of joint 2 comes to -10 mm from box 1 of keep_out.boxes_mm"
    assert keep_out.touched(ARM, np.radians([90.0, 0.0])) is None


def test_the_probe_is_as_large_as_it_is():
    """The flange of the level link points sideways: 0.2 m along its z the centre of the probe is at y = -0.2 m."""
    box = np.array([[[0.9, -0.6, 0.4], [1.1, -0.35, 0.6]]])
    for radius, touches in ((0.1, False), (0.2, True)):
        keep_out = KeepOut(-np.inf, box, 0.02, np.array([0.0, 0.0, 0.2]), radius)
        assert (keep_out.touched(ARM, np.zeros(2)) is not None) is touches
