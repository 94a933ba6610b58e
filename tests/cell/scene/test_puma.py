"""The packaged cells of the PUMA 260: published lengths, counts, coupling and poses."""

import dataclasses
import math

import numpy as np
import published_puma
import pytest
from puma_arm import ELBOW_FORM, MODELS, UPENN

from canprobe.cell.scene.load import read_cell
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset
from canprobe.mechanics.robot.model import joints_to_units


@pytest.mark.parametrize(("joint", "counts_per_turn"), list(enumerate((46720, 69973, 42987, 34809, 31508, 25415))))
def test_counts_per_joint_turn_are_the_published_ones(joint, counts_per_turn):
    q = np.zeros(6)
    q[joint] = 2 * math.pi
    assert joints_to_units(UPENN, q)[joint] == pytest.approx(counts_per_turn, abs=0.51)


def test_wrist_coupling_signs_and_sizes():
    turn_j4, turn_j5 = np.zeros(6), np.zeros(6)
    turn_j4[3] = turn_j5[4] = 2 * math.pi
    assert joints_to_units(UPENN, turn_j4)[4] == pytest.approx(-9.8462 * 800)
    assert joints_to_units(UPENN, turn_j4)[5] == pytest.approx(1.0 * 800)
    assert joints_to_units(UPENN, turn_j5)[5] == pytest.approx(-5.6 * 800)
    assert joints_to_units(UPENN, turn_j5)[3] == 0.0
    assert not np.any(np.triu(UPENN.units_per_q, 1)), "a motor never depends on a joint beyond it"


@pytest.mark.parametrize(
    ("cell", "lengths_mm"),
    [
        ("puma260", (330.2, 203.2, -127.0, 0.0, 203.2, 63.5)),
        ("puma260-unimate", (330.2, 198.1, -124.5, -19.05, 203.2, 55.9)),
    ],
)
def test_published_lengths(cell, lengths_mm):
    joints = read_cell(cell).joints.values()
    a, d = [joint.a_mm for joint in joints], [joint.d_mm for joint in joints]
    # base height, upper arm, shoulder offset, elbow offset, forearm, flange
    assert (d[0], a[1], d[1] + d[2], a[2], d[3], d[5]) == pytest.approx(lengths_mm, abs=0.05)


def test_known_poses_of_the_upenn_arm():
    # All angles zero: upper arm along +x, forearm and flange up, shoulder offset toward +y. Inches.
    T = forward(UPENN.chain, np.zeros(6))
    assert T[:3, 3] / 0.0254 == pytest.approx((8.0, 5.0, 13.0 + 8.0 + 2.5))
    assert T[:3, :3] == pytest.approx(np.eye(3))
    # Joint 1 by +90 degrees turns everything about base z.
    assert forward(UPENN.chain, [math.pi / 2, 0, 0, 0, 0, 0])[:3, 3] / 0.0254 == pytest.approx((-5.0, 8.0, 23.5))
    # Joint 2 by +90 degrees lifts the upper arm; the forearm then points backward.
    assert forward(UPENN.chain, [0, math.pi / 2, 0, 0, 0, 0])[:3, 3] / 0.0254 == pytest.approx((-10.5, 5.0, 21.0))


def test_elbow_form_points_down_into_the_scan_region():
    T = forward(UPENN.chain, ELBOW_FORM) @ tool_z_offset(80.0)
    assert T[:3, 2] == pytest.approx((0, 0, -1), abs=1e-12)
    assert -0.140 <= T[0, 3] <= -0.100
    assert -0.140 <= T[1, 3] <= -0.105
    assert T[2, 3] - 0.040 == pytest.approx(0.369, abs=0.010)


def test_the_packaged_cells_are_the_published_arms():
    for name, published in published_puma.MODELS.items():
        packaged = MODELS[name]
        assert packaged.chain.fixed == pytest.approx(published.chain.fixed, abs=1e-12)
        assert packaged.chain.T_last_flange == pytest.approx(published.chain.T_last_flange, abs=1e-12)
        assert packaged.units_per_q == pytest.approx(published.units_per_q, rel=1e-12)
        for joint, written in zip(packaged.joints, published.joints, strict=True):
            assert dataclasses.astuple(joint)[2:] == pytest.approx(dataclasses.astuple(written)[2:])
