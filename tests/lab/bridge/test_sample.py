"""The neutral sample against exact geometry: a sphere, a saddle, and a curvature that was not observed."""

import numpy as np
import pytest

from canprobe.lab.bridge.sample import ContactFrame, SurfacePatch

IN_BASE = np.eye(4)
IN_BASE[:3, 3] = (0.0, 0.0, 0.05)


def test_the_grid_of_a_patch_is_a_disc_of_the_quadric_and_its_axis_looks_inward():
    """At the pole of a ball about the origin of the base, in axes whose z points down into it."""
    T = IN_BASE @ np.diag([1.0, -1.0, -1.0, 1.0])
    patch = SurfacePatch(0, T, np.diag([20.0, 20.0]), np.eye(3), (True, True))
    points, sigma = patch.grid(radius=5e-3, n=11)
    assert len(points) == 81  # of 11 × 11 within the circle
    assert np.abs(np.linalg.norm(points, axis=1) - 0.05).max() < 5e-6  # the fourth order: x⁴ / 8 r³ < 1 µm
    assert points[:, 2].min() > 0.049  # the near side, not the mirror image beyond the tangent plane
    assert patch.kappa == pytest.approx((20.0, 20.0))
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
    contact = ContactFrame(IN_BASE @ np.diag([1.0, -1.0, -1.0, 1.0]))
    assert contact.normal.tolist() == [0.0, 0.0, 1.0] and contact.point.tolist() == [0.0, 0.0, 0.05]
