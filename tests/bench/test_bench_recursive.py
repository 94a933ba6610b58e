"""Costs of the online estimator. Run with --benchmark-only; skipped by default.

Goal on an idle machine: at most 150 us a sample, with correlated noise, and a twentieth of an answer of ml over 160.
"""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.fit import make_estimator
from canprobe.mechanics.touch.estimate.noise import Correlation
from canprobe.mechanics.touch.surface import SurfaceMatrix

SIGMA_POINT, SIGMA_NORMAL = 2e-5, 1e-3
CORRELATION = {"ml": None, "recursive": Correlation(1e-3, 0.8)}


def samples(n):
    """n noisy contacts, 0.125 mm apart, on a figure of 10 mm over a saddle."""
    s = np.arange(n) * 0.125e-3
    surface, rng = SurfaceMatrix.from_curvature([[20.0, 0.0], [0.0, -15.0]]), np.random.default_rng(0)
    x, y = 5e-3 * np.sin(s / 5e-3), 4e-3 * np.sin(s / 3.1e-3)
    points = np.stack([x, y, surface.height(x, y)], axis=1)
    normals = surface.normal(points) + SIGMA_NORMAL * rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points += SIGMA_POINT * rng.normal(size=points.shape)
    pose, pole = np.eye(4), np.array([0.0, 0.0, 0.04])
    return [ContactSample(5e-3 * i, points[i], normals[i], pose, pole, 1.0) for i in range(n)]


def settled(method):
    """An estimator after 480 samples, and those that come next."""
    estimator = make_estimator(
        method, sigma_point=SIGMA_POINT, sigma_normal=SIGMA_NORMAL, correlation=CORRELATION[method]
    )
    coming = iter(samples(60_000))
    for sample in itertools.islice(coming, 480):
        estimator.add(sample)
    return estimator, coming


def test_bench_add(benchmark):
    estimator, coming = settled("recursive")
    benchmark.pedantic(lambda: estimator.add(next(coming)), rounds=4000)
    assert estimator.estimate().rank == 3


@pytest.mark.parametrize("method", ["recursive", "ml"])
def test_bench_answer(benchmark, method):
    estimator, coming = settled(method)
    answer = benchmark.pedantic(estimator.estimate, setup=lambda: estimator.add(next(coming)), rounds=100)
    assert answer.rank == 3
