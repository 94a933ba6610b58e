"""Answers joined with ground that was touched before: the algebra, what is withheld, and a path that comes back."""

import math

import numpy as np
import pytest

from canprobe.mechanics.touch import (
    ContactSample,
    MapFusion,
    MapNoise,
    OnlineEstimator,
    PadLayer,
    SurfaceMap,
    fit_surface,
    make_estimator,
)
from canprobe.mechanics.touch.estimate.quadric import TO_Q
from canprobe.mechanics.touch.online.map_fusion import MEMORIES_BETWEEN, KnownCurvature, ground_at, joined

RADIUS, PAD, STIFFNESS, SIGMA = 0.05, 0.04, 1.2e8, {"sigma_point": 3e-5, "sigma_normal": 1e-3}
NOISE = MapNoise(3e-5, 3e-5, 1e-3)
MEMORY = 0.02


def contacts(path, seed=0, start_s=0.0):
    """Contacts of a ball of 50 mm with its top at the origin, under a path (n, 2), m; the layer is not squeezed."""
    rng = np.random.default_rng(seed)
    for i, (x, y) in enumerate(path):
        n = np.array([x / RADIUS, y / RADIUS, math.sqrt(1.0 - (x * x + y * y) / RADIUS**2)])
        p = RADIUS * (n - [0.0, 0.0, 1.0]) + SIGMA["sigma_point"] * rng.normal(size=3)
        up = n + SIGMA["sigma_normal"] * rng.normal(size=3)
        up /= np.linalg.norm(up)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.diag([1.0, -1.0, -1.0]), p + PAD * up
        yield ContactSample(start_s + 0.005 * i, p, up, T, T[:3, :3].T @ (-PAD * up), 0.0)


def weave(loops, x=0.0, y=0.0):
    """A closed weave of 24 by 8 mm about a place, some times over."""
    t = np.arange(0.0, loops, 1.0 / 800)
    return np.column_stack([x + 12e-3 * np.sin(2 * math.pi * t), y + 4e-3 * np.sin(6 * math.pi * t)])


def line(first, last):
    """A straight line along x."""
    x = np.arange(first, last, 0.125e-3)
    return np.column_stack([x, np.zeros_like(x)])


def estimate_of(path):
    samples = list(contacts(path))
    return fit_surface(np.array([s.p_base for s in samples]), np.array([s.n_base for s in samples]), **SIGMA)


def test_two_answers_are_one_by_their_informations():
    answer = estimate_of(weave(1)[:300])
    own = answer.covariance * np.outer(TO_Q, TO_Q)
    known = KnownCurvature(TO_Q * [20.3, 0.1, 19.8], np.diag([0.3, 0.5, 0.2]) ** 2)
    both = joined(answer, known)
    V = np.linalg.inv(np.linalg.inv(own) + np.linalg.inv(known.covariance))
    q = TO_Q * [answer.K[0, 0], answer.K[0, 1], answer.K[1, 1]]
    expected = V @ (np.linalg.solve(own, q) + np.linalg.solve(known.covariance, known.q))
    np.testing.assert_allclose(TO_Q * [both.K[0, 0], both.K[0, 1], both.K[1, 1]], expected, rtol=1e-9)
    np.testing.assert_allclose(both.covariance * np.outer(TO_Q, TO_Q), V, rtol=1e-9)
    np.testing.assert_array_equal(both.T_frame_contact, answer.T_frame_contact)
    gained = both.model_root.T @ both.model_root - answer.model_root.T @ answer.model_root
    np.testing.assert_allclose(gained[6:, 6:] * np.outer(0.5 / TO_Q, 0.5 / TO_Q), np.linalg.inv(known.covariance))
    assert "from ground that was touched before" in both.notes[-1]


def test_ground_that_contradicts_is_left_out():
    answer = estimate_of(weave(1)[:300])
    assert joined(answer, KnownCurvature(TO_Q * [40.0, 0.0, 20.0], 0.01 * np.eye(3))) is answer


def of_map(path):
    found = SurfaceMap(PadLayer(PAD, STIFFNESS), NOISE)
    found.add_samples(list(contacts(path, seed=1)))
    return found


def test_the_map_answers_where_it_observed_all_curvature():
    answer = estimate_of(weave(1)[:300])
    known = ground_at(of_map(weave(1)), answer)
    off = known.q - TO_Q * [1.0 / RADIUS, 0.0, 1.0 / RADIUS]
    assert np.abs(off).max() < 1.0
    assert off @ np.linalg.solve(known.covariance, off) < 11.0
    assert ground_at(of_map(weave(1, x=0.03)), answer) is None  # it was never here
    assert ground_at(of_map(line(-0.012, 0.012)), answer) is None


def answers(estimator, samples):
    found = []
    for k, sample in enumerate(samples, 1):
        estimator.add(sample)
        if k % 8 == 0 and (answer := estimator.estimate()) is not None:
            found.append(answer)
    return found


def error(found):
    K = np.array([one.K for one in found[20:]])
    return math.sqrt(np.mean((K - np.eye(2) / RADIUS) ** 2))


def test_a_path_that_comes_back_knows_more():
    samples = list(contacts(weave(3)))
    make = lambda: make_estimator("recursive", **SIGMA, memory_m=MEMORY)  # noqa: E731
    alone = answers(make(), samples)
    returning = OnlineEstimator(make(), MapFusion(SurfaceMap(PadLayer(PAD, STIFFNESS), NOISE), MEMORY))
    both = answers(returning, samples)
    with_ground = ["touched before" in str(one.notes) for one in both]
    first_loop = sum(len(weave(1)) > 8 * k for k in range(len(both)))
    assert np.mean(with_ground[first_loop + 20 :]) > 0.9
    for one, other in zip(alone[:15], both[:15], strict=True):  # nothing is known yet
        np.testing.assert_array_equal(one.K, other.K)
    assert error(both[first_loop:]) < 0.75 * error(alone[first_loop:])
    known = [one for one, has in zip(both, with_ground, strict=True) if has]
    z = [(one.K[0, 0] - 1.0 / RADIUS) / math.sqrt(one.covariance[0, 0]) for one in known]
    assert np.mean(np.abs(z) < 1.96) > 0.85
    assert returning.dropped.total == 0


def test_only_contacts_that_share_no_data_are_ground():
    ground = SurfaceMap(PadLayer(PAD, STIFFNESS), NOISE)
    motion = make_estimator("recursive", **SIGMA, memory_m=MEMORY)
    estimator = OnlineEstimator(motion, MapFusion(ground, MEMORY))
    answers(estimator, contacts(line(-0.02, 0.018)))
    assert len(ground) == 0
    still = np.tile([[0.018, 0.0]], (2000, 1))
    answers(estimator, contacts(still, start_s=5.0))  # noise at rest makes no way
    assert len(ground) == 0
    answers(estimator, contacts(line(0.018, 0.03), start_s=20.0))
    assert 0 < len(ground) < 15
    estimator.reset()  # contact was lost: the new answers share nothing with any contact
    assert len(ground) > 40
    assert pytest.approx(0.04) == MEMORIES_BETWEEN * MEMORY


def test_nodes_are_found_in_blocks_round_a_place():
    grid = of_map(np.concatenate([weave(1, a, b) for a in (-0.015, 0.0, 0.015) for b in (-0.01, 0.01)])).nodes
    place = np.array([3e-3, 1e-3, 0.0])
    points = grid.rows[:-1, :3] - PAD * grid.rows[:-1, 3:6]
    near = grid.near(place)
    within = np.linalg.norm(points - place, axis=1) < 12e-3
    found = np.linalg.norm(near[:, :3] - PAD * near[:, 3:6] - place, axis=1) < 12e-3
    assert found.sum() == within.sum() > 50
    assert len(near) < len(points)
