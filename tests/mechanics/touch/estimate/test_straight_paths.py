"""Straight paths over a torus: what they observe is right within its region, or said to be not observed."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from canprobe.mechanics.touch import Prior, fit_surface

CHI2_95 = {1: 3.841, 2: 5.991, 3: 7.815}
TO_Q = np.array([1.0, np.sqrt(2.0), 1.0])


def holds(estimate, line):
    """Whether the region of the observed combinations of K holds the truth; their error, 1/m."""
    P = estimate.T_frame_contact[:3, :2]
    D = 2.0 * estimate.S[:2, :2] - P.T @ line.tensor(estimate.point) @ P
    e = estimate.combinations @ (TO_Q * D[[0, 0, 1], [0, 1, 1]])
    information = estimate.combinations @ estimate.information @ estimate.combinations.T
    return e @ information @ e < CHI2_95[estimate.rank], np.linalg.norm(e)


@pytest.mark.parametrize(("method", "seeds", "sigma_point"), [("ml", 16, 5e-6), ("recursive", 8, 20e-6)])
def test_what_a_straight_path_over_a_torus_observes_is_right(torus_line, method, seeds, sigma_point):
    """A path as long as the tube's radius, anywhere on it in any direction. Taken for a quadric, nearly none is."""
    hits, errors = {False: [], True: []}, {False: [], True: []}
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        tube = rng.uniform(0.025, 0.045)
        line = torus_line(rng.uniform(0.07, 0.13), tube, rng.uniform(-1.2, 1.2), rng.uniform(0.0, np.pi), length=tube)
        points, normals = line.felt(sigma_point, 50.0 * sigma_point, rng)
        for quadric in (False, True):
            e = fit_surface(
                points,
                normals,
                sigma_point=sigma_point,
                sigma_normal=50.0 * sigma_point,
                method=method,
                quadric=quadric,
            )
            assert e.rank < 3
            if e.rank:
                held, error = holds(e, line)
                hits[quadric].append(held)
                errors[quadric].append(error)
    assert len(hits[False]) >= 0.75 * seeds
    assert np.mean(hits[False]) > 0.85
    assert np.mean(hits[True]) < 0.2
    assert np.mean(np.square(errors[False])) < 0.3 * np.mean(np.square(errors[True]))


def on_a_bend(rng):
    """A straight path whose curvature goes from 6 to 30 1/m: no quadric is near."""
    x = np.linspace(-0.02, 0.0, 160)
    points = np.stack([x, 0.0 * x, 15.0 * x**2 + 200.0 * x**3], axis=1)
    normals = np.stack([30.0 * x + 600.0 * x**2, 0.0 * x, -np.ones_like(x)], axis=1)
    return points + 1e-6 * rng.normal(size=points.shape), normals / np.linalg.norm(normals, axis=1, keepdims=True)


def test_a_straight_path_without_a_local_quadric_observes_nothing():
    """The motion is no evidence either: it knows K to no better than 1000 1/m."""
    e = fit_surface(*on_a_bend(np.random.default_rng(1)), sigma_point=5e-6, sigma_normal=2e-4)
    assert e.rank == 0 and np.isnan(e.K).all()
    assert any("varies too much" in note for note in e.notes)
    assert np.linalg.eigvalsh(e.evidence.information)[-1] < 1e-6
    assert_allclose(e.S[:2, :2], 0.0, atol=1e-9)


def test_without_a_local_quadric_a_prior_on_curvature_answers_alone():
    prior = Prior.flat(0.02, 30.0)
    e = fit_surface(*on_a_bend(np.random.default_rng(1)), sigma_point=5e-6, sigma_normal=2e-4, prior=prior)
    assert e.rank == 0 and not e.observed.any()
    assert_allclose(e.K, 0.0, atol=1e-9)
    assert np.sqrt(e.covariance[0, 0]) == pytest.approx(30.0, rel=0.05)
