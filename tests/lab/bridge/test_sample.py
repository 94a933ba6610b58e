"""The neutral sample against exact geometry: a sphere, a saddle, and a curvature that was not observed."""

import numpy as np
import pytest

import canprobe
from canprobe.lab.bridge.sample import ContactFrame, SurfacePatch

RADIUS = 0.05


@pytest.fixture
def estimate():
    """A sphere about the origin of the base, felt round (0, 0, r) where the last sample lies."""
    u, v = np.random.default_rng(3).uniform(-6e-3, 6e-3, (2, 200))
    u[-1] = v[-1] = 0.0
    normals = np.stack([u, v, np.full_like(u, RADIUS)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return canprobe.fit_surface(RADIUS * normals, normals, sigma_point=1e-5, sigma_normal=1e-3)


def patch_of(estimate):
    observed = (bool(estimate.observed[0]), bool(estimate.observed[1]))
    return SurfacePatch(0, estimate.T_frame_contact, estimate.K, estimate.covariance, observed)


def test_the_patch_of_an_estimate_lies_on_the_felt_sphere(estimate):
    patch = patch_of(estimate)
    points, sigma = patch.grid(radius=5e-3, n=11)
    r = np.linalg.norm(points, axis=1)
    assert len(points) == 81  # of 11 × 11 within the circle
    assert np.abs(r - RADIUS).max() < 5e-6  # the fourth order of a sphere over 5 mm: x⁴ / 8 r³ < 1 µm
    assert points[:, 2].min() > 0.049  # the near side, not the mirror image beyond the tangent plane
    assert patch.kappa == pytest.approx((20.0, 20.0), abs=0.3)
    assert sigma.min() == 0.0 and 0 < sigma.max() < 1e-4


def test_heights_and_their_deviation_are_those_of_the_quadric():
    K = np.array([[10.0, 3.0], [3.0, -20.0]])
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, 0.5], [0.0, 0.5, 3.0]])
    patch = SurfacePatch(0, np.eye(4), K, covariance, (True, True))
    xy = np.array([2e-3, -1e-3])
    z, sigma = patch.heights(*xy)
    assert z == pytest.approx(0.5 * xy @ K @ xy, rel=1e-12)
    draws = np.random.default_rng(1).multivariate_normal([10.0, 3.0, -20.0], covariance, 200_000)
    heights = 0.5 * draws[:, 0] * xy[0] ** 2 + draws[:, 1] * xy[0] * xy[1] + 0.5 * draws[:, 2] * xy[1] ** 2
    assert sigma == pytest.approx(heights.std(), rel=0.01)


def test_an_unobserved_curvature_is_not_drawn_as_known():
    patch = SurfacePatch(0, np.eye(4), np.full((2, 2), np.nan), np.full((3, 3), np.inf), (False, False))
    points, sigma = patch.grid(n=5)
    assert np.isfinite(points).all() and np.isinf(sigma).sum() == len(points) - 1
    assert np.isnan(patch.kappa).all()


def test_the_contact_frame_looks_inward():
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])  # z down, into an object that lies below
    T[:3, 3] = (0.1, 0.2, 0.3)
    contact = ContactFrame(T)
    assert contact.normal.tolist() == [0.0, 0.0, 1.0] and contact.point.tolist() == [0.1, 0.2, 0.3]
