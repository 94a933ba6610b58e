"""Correlated noise along the path: intervals that know of it cover, intervals that do not know of it do not."""

import math

import numpy as np
import pytest

from canprobe.mechanics.touch import Correlation, Prior, cramer_rao, fit_surface
from canprobe.mechanics.touch.estimate.noise import SlowErrors

SIGMA = {"sigma_point": 5e-5, "sigma_normal": 3e-3}
LENGTH, SHARE, STEP = 1.5e-3, 0.9, 0.125e-3
SEEDS = 50
CHI2_95 = 7.815
WEIGHT = np.array([1.0, 2.0, 1.0])
KNOWN = Correlation(LENGTH, SHARE)


def autoregression(n, rng):
    """(n, 3) of unit variance: a first-order autoregression over the path plus white noise."""
    rho = math.exp(-STEP / LENGTH)
    x = rng.normal(size=(n, 3))
    for i in range(1, n):
        x[i] = rho * x[i - 1] + math.sqrt(1.0 - rho * rho) * x[i]
    return math.sqrt(SHARE) * x + math.sqrt(1.0 - SHARE) * rng.normal(size=(n, 3))


def felt(path, seed):
    rng = np.random.default_rng(seed)
    n = len(path.points)
    points = path.points + SIGMA["sigma_point"] * autoregression(n, rng)
    normals = path.normals + SIGMA["sigma_normal"] * autoregression(n, rng)
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def scores(path, method, correlation, seeds=SEEDS):
    """Share of the 95 % regions that hold the truth, and the RMS error."""
    answers = [fit_surface(*felt(path, s), **SIGMA, method=method, correlation=correlation) for s in range(seeds)]
    errors = [path.error(a) for a in answers]
    held = [e @ np.linalg.solve(a.covariance, e) < CHI2_95 for e, a in zip(errors, answers, strict=True)]
    return float(np.mean(held)), math.sqrt(float(np.mean(np.square(errors) @ WEIGHT)))


@pytest.mark.parametrize("method", ["ml", "recursive"])
def test_intervals_cover_when_they_know(method, truth):
    path = truth.path("ellipsoid")
    cover, _ = scores(path, method, KNOWN)
    # 50 seeds: three standard deviations of the count of a true 95 % are 9 %
    assert cover >= 0.86
    blind, _ = scores(path, method, None, seeds=20)
    assert blind < 0.75


def test_ml_reaches_the_bound_of_its_noise(truth):
    path = truth.path("cylinder")
    C = cramer_rao(path.points, path.normals, path.surface, **SIGMA, correlation=KNOWN)
    white = cramer_rao(path.points, path.normals, path.surface, **SIGMA)
    _, rms = scores(path, "ml", KNOWN, seeds=40)
    bound = math.sqrt(WEIGHT @ np.diag(C))
    # 40 seeds of about three independent entries: two standard deviations of an RMS are 13 %
    assert 0.8 * bound < rms < 1.1 * 1.13 * bound
    assert bound > 1.5 * math.sqrt(WEIGHT @ np.diag(white))


def test_whitening_is_the_inverse_of_the_correlation():
    path = np.cumsum(np.random.default_rng(0).uniform(0.0, 1e-3, 30))
    W = KNOWN.whitener(path)
    expected = SHARE * np.exp(-np.abs(np.subtract.outer(path, path)) / LENGTH) + (1.0 - SHARE) * np.eye(30)
    assert np.allclose(W.mT @ W @ expected, np.eye(30), atol=1e-6)


def test_slow_errors_take_their_part_of_the_variance_first():
    """Whatever is said of the rest: where slow errors are nearly all of the error, they are all that is correlated."""
    path, slow = np.linspace(0.0, 0.01, 40), SlowErrors(np.full(40, 0.999), np.linspace(0.0, 1e-6, 40))
    R = Correlation(2e-3, 0.8, pad_length=1.0).matrix(path, slow)
    assert np.linalg.eigvalsh(R)[:, 0].min() > 0.0
    assert R[1, 0, 1] == pytest.approx(0.999**2 + 0.8 * (1.0 - 0.999**2) * np.exp(-0.01 / 39 / 2e-3), abs=1e-5)


def test_coupled_errors_are_one_error():
    """One centroid gives point and normal: its error is felt as (K + 1/R_p) e. Only stated so do regions cover."""
    rng = np.random.default_rng(7)
    radius, probe, e = 0.05, 0.04, 40e-6
    t = np.linspace(-1.0, 0.0, 120)
    true = np.stack([0.2 * t, 0.08 * np.sin(11.0 * t), -np.ones_like(t)], axis=1)
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    inside: dict[float, list[bool]] = {1.0 / probe: [], 0.0: []}
    for _ in range(60):
        error = e * rng.normal(size=true.shape)
        error -= true * np.sum(error * true, axis=1, keepdims=True)
        points = radius * true + error + 10e-6 * rng.normal(size=(len(t), 1)) * true
        normals = true - error / probe
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        for coupling, hits in inside.items():
            tilt = 1e-4 if coupling else e / probe  # the same normals, taken for independent ones
            found = fit_surface(points, normals, sigma_point=e, sigma_normal=tilt, coupling=coupling, quadric=True)
            d = (found.K - np.eye(2) / radius)[[0, 0, 1], [0, 1, 1]]
            hits.append(bool(d @ np.linalg.solve(found.covariance, d) < 7.815))
    assert np.mean(inside[1.0 / probe]) >= 0.9
    assert np.mean(inside[0.0]) <= np.mean(inside[1.0 / probe]) - 0.1


# The prior on curvature prefers no direction: it looks at the tensor as a whole.

PATH_LENGTH, SIGMA_OF_BOTH = 0.01, 25.0


@pytest.mark.parametrize(("kappa", "angle"), [((30.0, 10.0), 0.0), ((30.0, -30.0), 0.3), ((20.0, 0.0), 1.9)])
def test_a_flat_prior_weighs_the_curvature_tensor_alike_from_every_side(kappa, angle):
    """Σ ((K11 / σ)², (K12 / (σ √½))², (K22 / σ)²) is the tensor's norm over σ, which no turn of the axes changes."""
    turn = np.array(((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))))
    K = turn @ np.diag(kappa) @ turn.T
    rows, wanted = Prior.flat(PATH_LENGTH, SIGMA_OF_BOTH).rows(PATH_LENGTH)
    half = np.zeros(9)
    half[6:] = 0.5 * PATH_LENGTH * np.array((K[0, 0], K[0, 1], K[1, 1]))
    assert wanted.tolist() == [0.0] * 6
    assert np.linalg.norm(rows @ half) == pytest.approx(np.hypot(*kappa) / SIGMA_OF_BOTH, rel=1e-12)
