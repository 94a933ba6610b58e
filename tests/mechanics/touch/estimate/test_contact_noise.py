"""Noise of contacts along the surface and along the normal apart, and slow errors that last while the pad rests."""

from dataclasses import replace

import numpy as np
import pytest

from canprobe.mechanics.touch import ContactSample, Correlation, fit_surface, make_estimator

RADIUS, PROBE = 0.05, 0.04
POINT, HEIGHT, NORMAL = 40e-6, 10e-6, 0.5e-3
COUPLING = 1.0 / PROBE


def contacts(seed=0, n=240):
    """Contacts of a weave over a sphere; the pad rests."""
    rng, s = np.random.default_rng(seed), np.linspace(0.0, 1.0, n)
    normals = np.stack([0.4 * s - 0.2, 0.1 * np.sin(18.0 * s), np.full(n, -0.95)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = RADIUS * normals + HEIGHT * rng.normal(size=(n, 1)) * normals
    pole = np.array([0.0, 0.0, PROBE])
    return [
        ContactSample(5e-3 * i, points[i], normals[i], np.eye(4), pole, 2.0, POINT, NORMAL, sigma_height=HEIGHT)
        for i in range(n)
    ]


def answered(samples, method="recursive", correlation=None):
    settings = {"sigma_point": POINT, "sigma_normal": NORMAL, "coupling": COUPLING, "correlation": correlation}
    estimator = make_estimator(method, window=len(samples), **settings)
    for sample in samples:
        estimator.add(sample)
    return estimator.estimate()


def test_a_height_is_a_covariance_along_the_normal():
    samples = contacts()
    points, normals = (np.array([getattr(s, name) for s in samples]) for name in ("p_base", "n_base"))
    along = normals[:, :, None] * normals[:, None, :]
    covariances = POINT**2 * (np.eye(3) - along) + HEIGHT**2 * along
    whole = fit_surface(points, normals, sigma_point=covariances, sigma_normal=NORMAL, coupling=COUPLING)
    found = answered(samples, "ml")
    np.testing.assert_allclose(found.K, whole.K, atol=0.02)
    np.testing.assert_allclose(found.covariance, whole.covariance, rtol=0.02, atol=1e-5)


@pytest.mark.parametrize("method", ["recursive", "ml"])
def test_one_noise_for_both_is_still_accepted_and_a_height_tells_more(method):
    samples = contacts()
    known, both = answered(samples, method), answered([replace(s, sigma_height=None) for s in samples], method)
    np.testing.assert_allclose(known.kappa, 20.0, atol=1.0)
    assert np.trace(known.covariance) < 0.95 * np.trace(both.covariance)


@pytest.mark.parametrize("method", ["recursive", "ml"])
def test_a_slow_error_bends_a_surface_only_where_the_contact_moves_over_the_pad(method):
    correlation = Correlation(2e-3, 0.0, pad_length=0.3e-3)
    resting = [replace(s, sigma_slow=0.7 * POINT) for s in contacts()]
    way = np.cumsum(np.full(len(resting), 8e-6))
    moving = [
        replace(s, r_probe=PROBE * np.array([np.sin(w / PROBE), 0.0, np.cos(w / PROBE)]))
        for s, w in zip(resting, way, strict=True)
    ]
    alone, rests, moves = (
        float(np.trace(answered(samples, method, correlation).covariance)) for samples in (contacts(), resting, moving)
    )
    assert rests < 2.0 * alone  # a filter that forgets takes some of one error for all as a bend
    assert moves > 2.5 * rests


def test_a_height_without_noise_is_dropped():
    estimator = make_estimator("recursive", sigma_point=POINT, sigma_normal=NORMAL)
    estimator.add(replace(contacts()[0], sigma_height=0.0))
    assert estimator.dropped.zero_sigma == 1
