"""Online estimators: the algebra under the filter, the length of a path, and a reset."""

from __future__ import annotations

import math

import numpy as np
import pytest

from canprobe.mechanics.touch import make_estimator
from canprobe.mechanics.touch.estimate import quadric, residuals
from canprobe.mechanics.touch.estimate.noise import make_noise
from canprobe.mechanics.touch.estimate.path_length import PathLength, Spread


def make(method="recursive"):
    return make_estimator(method, sigma_point=2e-5, sigma_normal=1e-3)


def fed(estimator, samples):
    for sample in samples:
        estimator.add(sample)
    return estimator.estimate()


def test_rows_are_the_derivative_of_residuals(truth):
    path = truth.path("ellipsoid")
    S = path.surface.S.copy()
    S[:3, :3] *= 0.02
    c = quadric.parameters_of(S)
    d = residuals.design(path.points / 0.02, path.normals, make_noise(160, 1e-9, 1.0))
    J, h = residuals.linearise(c, d).jacobian(), 1e-6
    numeric = [(residuals.linearise(c + h * e, d).r - residuals.linearise(c - h * e, d).r) / (2 * h) for e in np.eye(9)]
    assert np.allclose(J[:, 1:], np.moveaxis(numeric, 0, 2)[:, 1:], atol=1e-8)
    assert np.allclose(J[:, 0] * 1e-9, np.moveaxis(numeric, 0, 2)[:, 0] * 1e-9, atol=1e-8)


def test_transport_is_the_congruence_and_its_derivative():
    rng = np.random.default_rng(2)
    c = 0.3 * rng.normal(size=9)
    T = np.eye(4)
    T[:3, :3], _ = np.linalg.qr(np.eye(3) + 0.1 * rng.normal(size=(3, 3)))
    T[:3, :3] *= np.sign(np.diag(T[:3, :3]))
    T[:3, 3] = 0.1 * rng.normal(size=3)
    new, M = residuals.transport(c, T)
    S = T.T @ quadric.matrix_of(c) @ T
    assert np.allclose(quadric.matrix_of(new), S * (-0.5 / S[2, 3]))
    h = 1e-6
    numeric = [
        (residuals.transport(c + h * e, T)[0] - residuals.transport(c - h * e, T)[0]) / (2 * h) for e in np.eye(9)
    ]
    assert np.allclose(M, np.transpose(numeric), atol=1e-8)


def test_slow_motion_is_not_believed_more_than_its_path_allows(truth):
    def sigma(step):
        s = np.arange(0, 0.02, step)
        path = truth.placed(truth.surface("cylinder"), 5e-3 * np.sin(s / 5e-3), 4e-3 * np.sin(s / 3.1e-3))
        return math.sqrt(fed(make(), truth.samples(*path.noisy(2e-5, 1e-3, 0))).covariance[0, 0])

    usual, slow = sigma(0.125e-3), sigma(0.004e-3)
    assert 0.6 * usual < slow  # 31 times the samples


@pytest.mark.parametrize("method", ["ml", "recursive"])
def test_reset_forgets(method, truth):
    path = truth.path("sphere")
    fresh = fed(make(method), truth.samples(path.points, path.normals))
    estimator = make(method)
    other = truth.path("saddle")
    fed(estimator, truth.samples(other.points, other.normals))
    estimator.reset()
    assert estimator.estimate() is None
    again = fed(estimator, truth.samples(path.points, path.normals))
    assert np.array_equal(again.K, fresh.K)


class TestPathLength:
    def test_noise_is_no_path(self):
        rng = np.random.default_rng(0)
        travel = PathLength(3 * 5e-5)
        assert sum(travel.add(x) for x in 5e-5 * rng.normal(size=(50000, 3))) == 0.0

    def test_motion_is(self):
        rng = np.random.default_rng(0)
        travel = PathLength(0.5e-3)
        x = np.outer(np.arange(800) * 0.125e-3, [0.6, 0.8, 0.0])
        got = sum(travel.add(p) for p in x + 5e-5 * rng.normal(size=x.shape))
        assert got == pytest.approx(0.1, rel=0.05)
        assert travel.total == pytest.approx(got, rel=1e-12)

    def test_spread_is_the_weighted_covariance(self):
        rng = np.random.default_rng(1)
        x = 5.0 + rng.normal(size=(60, 3))
        spread = Spread()
        for k in range(6):
            spread.fade(0.8)
            spread.add(x[10 * k : 10 * k + 10], np.full(10, 0.5))
        w = 0.5 * np.repeat(0.8 ** np.arange(5, -1, -1), 10)
        assert spread.weight == pytest.approx(w.sum())
        assert np.allclose(spread.covariance, np.cov(x.T, aweights=w, ddof=0))
