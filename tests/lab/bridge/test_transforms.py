"""The tree of frames against the arm's closed-form kinematics, and quaternions against scipy's."""

from functools import reduce

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from puma_arm import MODELS
from scipy.spatial.transform import Rotation

from canprobe.lab.bridge.description import flange_transform, link_transforms, quaternion_of
from canprobe.mechanics.robot.chain import forward


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_the_chain_of_links_ends_at_the_flange(model):
    for q in np.random.default_rng(2).uniform(model.q_min, model.q_max, (50, 6)):
        links = [*link_transforms(model.chain, q), flange_transform(model.chain)]
        assert [child for _, child, _ in links[:-1]] == [parent for parent, _, _ in links[1:]]
        product = reduce(np.matmul, (T for _, _, T in links))
        np.testing.assert_allclose(product, forward(model.chain, q), atol=1e-12)


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
