"""Quaternions of frames against scipy's; test_description.py has the tree of frames."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from canprobe.lab.bridge.description import quaternion_of


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_a_quaternion_turns_as_its_matrix(q):
    rotation = Rotation.from_quat(q)
    found = quaternion_of(rotation.as_matrix())
    assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-9)
    assert found[3] >= 0
    np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), rotation.as_matrix(), atol=1e-8)


@pytest.mark.parametrize("axis", range(3))
def test_a_half_turn_has_a_quaternion_too(axis):
    R = -np.eye(3)
    R[axis, axis] = 1.0
    assert np.abs(quaternion_of(R)).tolist() == np.eye(4)[axis].tolist()
