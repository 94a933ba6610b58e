"""Surfaces of patches: the blend, what a patch knows, and which answers along a path are kept."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from canprobe.lab.studies.shapes.patches import UNSEEN_CURVATURE_SIGMA, LocalPatch, PatchSurface, patch_of, spaced
from canprobe.mechanics.touch.estimate.fit import fit_surface
from canprobe.mechanics.touch.surface import SurfaceMatrix

RADIUS = 0.05
BALL = SurfaceMatrix(np.diag([1.0, 1.0, 1.0, -(RADIUS**2)]) / (2 * RADIUS))
SIGMA = {"sigma_point": 2e-5, "sigma_normal": 1e-3}


def at(angle, side=0.0, height=0.0):
    """A point over the ball, and the outward normal there."""
    n = np.array([math.sin(angle), math.sin(side), math.cos(angle)])
    n /= np.linalg.norm(n)
    return (RADIUS + height) * n, n


def exact_patch(point, *, variance=1.0, lifted=0.0, height_known=True):
    """A patch with the exact matrix at the foot of a point, or lifted off the surface; K known to `variance`."""
    T = BALL.contact_frame(BALL.project(point))
    S = BALL.normalised_at(T[:3, 3]).transformed(T).S
    T = T.copy()
    T[:3, 3] -= lifted * T[:3, 2]
    return LocalPatch(T, S, variance * np.diag([1e-6, 1e-6, 1e-10, 1.0, 1.0, 1.0, 0.1, 0.1, 0.1]), height_known)


def exact_surface(lifts=(0.0,) * 12, **changes):
    """Exact patches every 2 mm along a meridian."""
    angles = np.arange(12) * 2e-3 / RADIUS
    return PatchSurface([exact_patch(at(a)[0], lifted=h, **changes) for a, h in zip(angles, lifts, strict=True)])


@pytest.mark.parametrize("height", [-2e-3, 0.0, 1e-3, 15e-3])
def test_exact_patches_give_the_exact_closest_point(height):
    for angle, side in ((0.0, 0.0), (0.131, 0.02), (0.3, -0.05)):
        p, n = at(angle, side, height)
        answer = exact_surface().closest([p])
        assert answer.pieces[0] >= 2
        assert answer.height[0] == pytest.approx(height, abs=2e-8)
        np.testing.assert_allclose(answer.point[0], at(angle, side)[0], atol=2e-8)
        np.testing.assert_allclose(answer.normal[0], n, atol=2e-6)


def test_where_no_patch_is_near_there_is_no_answer():
    far = np.array([at(0.2, 0.09)[0], at(-0.09)[0], -at(0.2)[1]])
    answer = exact_surface().closest([far[0], at(0.2)[0], *far[1:]])
    for values in answer[:4]:
        np.testing.assert_array_equal(np.isfinite(values).reshape(4, -1).all(axis=1), [False, True, False, False])
    assert np.isnan(PatchSurface([]).closest(far).height).all()
    assert np.isnan(PatchSurface([]).curvature(far)).all()


def test_a_blend_lies_between_its_patches_and_has_no_steps_and_no_kinks():
    low = exact_patch(at(0.0)[0])
    for variance, share in ((1.0, 0.5), (1 / 9, 0.9), (9.0, 0.1)):
        high = exact_patch(at(0.04)[0], variance=variance, lifted=1e-4)
        height = PatchSurface([low, high]).closest([at(0.02)[0]]).height[0]
        assert height == pytest.approx(-share * 1e-4, rel=2e-3)  # a lifted surface is above the point
    rough = exact_surface(np.random.default_rng(0).normal(0.0, 1e-4, 12))
    angles = np.linspace(0.0, 0.4, 4001)
    heights = rough.closest([at(a, 0.01)[0] for a in angles]).height
    slopes = np.diff(heights) / (RADIUS * np.diff(angles))
    assert np.ptp(heights) > 5e-5
    assert np.abs(slopes).max() < 0.3
    assert np.abs(np.diff(slopes)).max() < 0.01  # where a patch enters or leaves, too


def test_a_patch_that_does_not_know_its_height_says_nothing_about_sigma():
    p = [at(0.2)[0]]
    known, blind = exact_surface().closest(p), exact_surface(height_known=False).closest(p)
    assert blind.height == pytest.approx(known.height, abs=1e-9)
    assert np.isnan(blind.sigma).all()


@pytest.mark.parametrize("method", ["ml", "recursive"])
def test_what_a_straight_path_leaves_open_is_wide(method):
    rng = np.random.default_rng(1)
    s = np.linspace(-10e-3, 10e-3, 160)
    n = np.stack([np.sin(s / RADIUS), 0 * s, np.cos(s / RADIUS)], axis=1) + 1e-3 * rng.normal(size=(160, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    p = RADIUS * np.stack([np.sin(s / RADIUS), 0 * s, np.cos(s / RADIUS)], axis=1) + 2e-5 * rng.normal(size=(160, 3))
    estimate = fit_surface(p, n, **SIGMA, method=method)
    patch = patch_of(estimate)
    assert estimate.rank == 2
    row = np.zeros(9)
    across = np.array([0.0, 1.0, 0.0]) @ patch.T_base_contact[:3, :2]
    row[6:] = 2 * across[0] ** 2, 4 * across[0] * across[1], 2 * across[1] ** 2
    assert math.sqrt(row @ patch.covariance @ row) == pytest.approx(UNSEEN_CURVATURE_SIGMA / estimate.distance, rel=0.1)


def test_answers_are_kept_by_path_not_by_time():
    """A contact that stands still for 50 answers adds no patch, and those that observed nothing are left out."""
    along = np.concatenate([np.full(50, 1e-3), 1e-3 + np.arange(60) * 0.4e-3, np.full(30, 24.6e-3)])
    records = [SimpleNamespace(travelled_m=s, estimate=SimpleNamespace(rank=3)) for s in along]
    assert [round(1e3 * one.travelled_m, 3) for one in spaced(records, 2e-3)] == [1 + 2 * i for i in range(12)]
    assert spaced(records)[0] is records[0]
    blind = [SimpleNamespace(travelled_m=s, estimate=SimpleNamespace(rank=0)) for s in along]
    assert spaced(blind) == []
