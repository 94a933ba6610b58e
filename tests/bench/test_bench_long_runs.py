"""Long runs of the online filter. Run with --benchmark-only; skipped by default. Three minutes on an idle machine."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.fit import make_estimator
from canprobe.mechanics.touch.surface import SurfaceMatrix

SIGMA_POINT, SIGMA_NORMAL = 2e-5, 1e-3
T, POLE = np.eye(4), np.array([0.0, 0.0, 0.04])


@pytest.fixture
def estimator():
    return make_estimator("recursive", sigma_point=SIGMA_POINT, sigma_normal=SIGMA_NORMAL)


def way(n):
    """n noisy samples, 0.125 mm apart, on a figure of 10 mm over a saddle."""
    s = np.arange(n) * 0.125e-3
    surface = SurfaceMatrix.from_curvature([[20.0, 0.0], [0.0, -15.0]])
    x, y = 5e-3 * np.sin(s / 5e-3), 4e-3 * np.sin(s / 3.1e-3)
    points = np.stack([x, y, surface.height(x, y)], axis=1)
    rng = np.random.default_rng(0)
    normals = surface.normal(points) + SIGMA_NORMAL * rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return surface, points + SIGMA_POINT * rng.normal(size=points.shape), normals


def feed(estimator, points, normals, n, t0):
    m = len(points)
    for i in range(n):
        estimator.add(ContactSample(t0 + 0.005 * i, points[i % m], normals[i % m], T, POLE, 1.0))


def check(e, surface, point):
    K, B = surface.curvature_at(point)
    P = e.T_frame_contact[:3, :2]
    assert e.rank == 3
    assert np.array_equal(e.S, e.S.T)
    assert (np.linalg.eigvalsh(e.covariance) > 0).all()
    assert np.linalg.norm(e.K - P.T @ B @ K @ B.T @ P) < 1.0


def test_1e6_updates_at_rest_after_a_scan(estimator, benchmark):
    surface, points, normals = way(800)
    feed(estimator, points, normals, 800, 0.0)
    cloud = points[-1] + SIGMA_POINT * np.random.default_rng(1).normal(size=(5000, 3))
    resting = np.repeat(normals[-1:], 5000, axis=0)
    benchmark.pedantic(feed, (estimator, cloud, resting, 1_000_000, 10.0), rounds=1)
    check(estimator.estimate(), surface, points[-1])


def test_an_hour_at_rest_and_then_motion(estimator, benchmark):
    surface, points, normals = way(800)
    cloud = points[0] + SIGMA_POINT * np.random.default_rng(1).normal(size=(5000, 3))
    resting = np.repeat(normals[:1], 5000, axis=0)
    benchmark.pedantic(feed, (estimator, cloud, resting, 720_000, 0.0), rounds=1)
    answer = estimator.estimate()
    assert answer is None or not answer.observed.any()
    feed(estimator, points[:160], normals[:160], 160, 3600.0)
    check(estimator.estimate(), surface, points[159])


def test_1e6_updates_in_motion(estimator, benchmark):
    surface, points, normals = way(1_000_000)
    benchmark.pedantic(feed, (estimator, points, normals, 1_000_000, 0.0), rounds=1)
    check(estimator.estimate(), surface, points[-1])
