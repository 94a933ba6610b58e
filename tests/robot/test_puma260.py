"""The arm's numbers: geometry, counts per turn, wrist coupling, ranges."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.robot.puma260 import MODELS, UPENN, PumaModel, counts_to_joints, joints_to_counts

ANGLES = st.lists(st.floats(-7, 7), min_size=6, max_size=6)


@pytest.mark.parametrize(("joint", "counts_per_turn"), list(enumerate((46720, 69973, 42987, 34809, 31508, 25415))))
def test_counts_per_joint_turn_are_the_published_ones(joint, counts_per_turn):
    q = np.zeros(6)
    q[joint] = 2 * math.pi
    assert joints_to_counts(UPENN, q)[joint] == pytest.approx(counts_per_turn, abs=0.51)


def test_wrist_coupling_signs_and_sizes():
    turn_j4, turn_j5 = np.zeros(6), np.zeros(6)
    turn_j4[3] = turn_j5[4] = 2 * math.pi
    assert joints_to_counts(UPENN, turn_j4)[4] == pytest.approx(-9.8462 * 800)
    assert joints_to_counts(UPENN, turn_j4)[5] == pytest.approx(1.0 * 800)
    assert joints_to_counts(UPENN, turn_j5)[5] == pytest.approx(-5.6 * 800)
    assert joints_to_counts(UPENN, turn_j5)[3] == 0.0
    assert not np.any(np.triu(UPENN.counts, 1)), "a motor never depends on a joint beyond it"


@given(ANGLES)
def test_counts_round_trip(q):
    assert counts_to_joints(UPENN, joints_to_counts(UPENN, q)) == pytest.approx(q, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "lengths_mm"),
    [("upenn", (330.2, 203.2, -127.0, 0.0, 203.2, 63.5)), ("unimate", (330.2, 198.1, -124.5, -19.05, 203.2, 55.9))],
)
def test_published_lengths(name, lengths_mm):
    # base height, upper arm, shoulder offset, elbow offset, forearm, flange
    assert np.array(MODELS[name].links) * 1e3 == pytest.approx(lengths_mm, abs=0.05)


def test_models_are_read_only_and_name_themselves():
    for name, model in MODELS.items():
        assert model.name == name
        for array in (model.dh, model.q_min, model.q_max, model.qd_max, model.counts):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 1.0


@pytest.mark.parametrize(("row", "column"), [(0, 0), (3, 0), (4, 2), (1, 1)])
def test_a_geometry_outside_the_puma_pattern_is_refused(row, column):
    dh = UPENN.dh.copy()
    dh[row, column] += 0.01
    with pytest.raises(ValueError, match="PUMA pattern"):
        PumaModel("bent", dh, UPENN.q_min, UPENN.q_max, UPENN.qd_max, UPENN.counts)
