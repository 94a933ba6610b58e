"""The packaged cells of the PUMA 260: the published arms, and poses by hand."""

import dataclasses
import math

import numpy as np
import published_puma
import pytest
from puma_arm import MODELS, UPENN

from canprobe.mechanics.robot.chain import forward


def test_known_poses_of_the_upenn_arm():
    # All angles zero: upper arm along +x, forearm and flange up, shoulder offset toward +y. Inches.
    T = forward(UPENN.chain, np.zeros(6))
    assert T[:3, 3] / 0.0254 == pytest.approx((8.0, 5.0, 13.0 + 8.0 + 2.5))
    assert T[:3, :3] == pytest.approx(np.eye(3))
    # Joint 1 by +90 degrees turns everything about base z.
    assert forward(UPENN.chain, [math.pi / 2, 0, 0, 0, 0, 0])[:3, 3] / 0.0254 == pytest.approx((-5.0, 8.0, 23.5))
    # Joint 2 by +90 degrees lifts the upper arm; the forearm then points backward.
    assert forward(UPENN.chain, [0, math.pi / 2, 0, 0, 0, 0])[:3, 3] / 0.0254 == pytest.approx((-10.5, 5.0, 21.0))


def test_the_packaged_cells_are_the_published_arms():
    for name, published in published_puma.MODELS.items():
        packaged = MODELS[name]
        assert packaged.chain.fixed == pytest.approx(published.chain.fixed, abs=1e-12)
        assert packaged.chain.T_last_flange == pytest.approx(published.chain.T_last_flange, abs=1e-12)
        assert packaged.units_per_q == pytest.approx(published.units_per_q, rel=1e-12)
        for joint, written in zip(packaged.joints, published.joints, strict=True):
            assert dataclasses.astuple(joint)[2:] == pytest.approx(dataclasses.astuple(written)[2:])
