"""What is wrong or missing in the paper's scheme, each point shown."""

from __future__ import annotations

import math

import numpy as np
import pytest

from canprobe.mechanics.touch import fit_surface, make_estimator
from canprobe.mechanics.touch.carrier import CarrierMotion
from canprobe.mechanics.touch.estimate import residuals
from canprobe.mechanics.touch.estimate.differences import three_rows
from canprobe.mechanics.touch.estimate.likelihood import fit_ml, make_touches, working_frame
from canprobe.mechanics.touch.estimate.noise import make_noise
from canprobe.mechanics.touch.estimate.window import paper_rates

R = 0.036
SIX = [0, 1, 2, 4, 5, 7]
"""Places of c11 c12 c13 c22 c23 c33 in the ten of (31)."""


def paper_system(x, y):
    """A ((3N+1), 10) and b ((3N+1),) of (30)–(34); the fourth components of x and y (N, 3) are 0."""
    A = np.zeros((3 * len(y) + 1, 10))
    A[:-1, SIX] = three_rows(y)
    A[-1, 9] = 1.0  # the boundary condition f = 0 at the origin
    return A, np.append(-x.reshape(-1), 0.0)


def test_a_is_never_of_rank_ten():
    rng = np.random.default_rng(0)
    A, b = paper_system(rng.normal(size=(50, 3)), rng.normal(size=(50, 3)))
    assert A.shape == (151, 10)
    assert b.shape == (151,)
    assert np.linalg.matrix_rank(A) == 7  # six, and the boundary row
    assert not A[:-1, [3, 6, 8, 9]].any()
    assert np.linalg.matrix_rank(A.T @ A) < 10  # (35)
    # of least norm is the solution of the six that are left
    six = np.linalg.lstsq(A[:-1, SIX], b[:-1], rcond=None)[0]
    assert np.allclose(np.linalg.pinv(A) @ b, np.insert(six, [3, 5, 6, 6], 0.0), atol=1e-12)


@pytest.mark.parametrize(("angle", "zeros"), [(0.0, 1), (0.5 * math.pi, 3)])
def test_a_straight_path_has_zero_singular_values(angle, zeros, truth):
    path = truth.straight("cylinder", angle)
    s = np.linalg.svd(three_rows(np.diff(path.points, axis=0)), compute_uv=False)
    assert np.sum(s < 1e-12 * s[0]) == zeros


def test_twice_s_is_meant(truth):
    """Pure sliding of a flat probe: x is the whole change of the normal, and A c = −x gives 2S, not S."""
    path = truth.path("sphere")
    y, x = np.diff(path.points, axis=0), -np.diff(path.normals, axis=0)
    A, b = paper_system(x, y)
    c = np.linalg.lstsq(A, b, rcond=None)[0]
    assert c[0] == pytest.approx(20.0, rel=1e-9)
    assert truth.surface("sphere").S[0, 0] == pytest.approx(10.0)


@pytest.mark.parametrize(("name", "low", "high"), [("ellipsoid", 0.02, 0.15), ("hyperboloid", 0.05, 0.30)])
def test_a_bias_without_noise_where_the_gradient_varies(name, low, high, truth):
    path = truth.path(name)
    K = path.surface.curvature_at([0, 0, 0])[0]
    errors = {}
    for method in ("chen1996", "chord", "ml"):
        e = fit_surface(path.points, path.normals, sigma_point=1e-8, sigma_normal=1e-8, method=method, lag=1)
        errors[method] = np.linalg.norm(e.K - K) / np.linalg.norm(K)
    assert low < errors["chen1996"] < high
    assert low / 2 < errors["chord"] < high
    assert errors["ml"] < 1e-6


# Errors in variables: percent of bias by noise of the centroid and lag, straight across a cylinder.
@pytest.mark.parametrize(
    ("noise", "lag", "percent", "within"),
    [
        (1e-4, 1, -107, 12),
        (1e-4, 5, -9, 3),
        (1e-4, 10, -2, 1.5),
        (5e-5, 1, -46, 8),
        (5e-5, 5, -2.4, 1),
        (5e-5, 10, -0.6, 0.6),
    ],
)
def test_noise_on_both_sides(noise, lag, percent, within, truth):
    s = (np.arange(160) - 159) * 0.125e-3
    path = truth.placed(truth.surface("cylinder"), R * np.sin(s / R), np.zeros(160))
    kappa = []
    for seed in range(16):
        estimator = make_estimator("chen1996", sigma_point=noise, sigma_normal=1e-3, lag=lag)
        for sample in truth.felt(path, noise, seed):
            estimator.add(sample)
        kappa.append(2 * estimator.estimate().S[0, 0])
    assert 100 * (np.mean(kappa) * R - 1) == pytest.approx(percent, abs=within)


def test_the_papers_rates_are_the_object_fixed_ones(truth):
    path = truth.path("ellipsoid")
    felt = list(truth.felt(path, 0.5e-3, 1))[:25]
    older, newer = felt[:20], felt[5:]
    x, y = paper_rates(
        *(np.array([getattr(s, name) for s in felt]) for name in ("T_base_probe", "r_probe", "n_base")), 5
    )
    assert np.allclose(y, [b.p_base - a.p_base for a, b in zip(older, newer, strict=True)], atol=2e-6)
    assert np.allclose(-x, [b.n_base - a.n_base for a, b in zip(older, newer, strict=True)], atol=5e-5)


@pytest.mark.parametrize("point", [(0.02, -0.03, 0.01), None])
def test_the_rates_over_a_moving_object_are_those_in_its_frame(truth, point):
    """(16)–(19) with ω_o and V_o in base, half-way between two samples, and without them on the object."""
    motion = CarrierMotion(np.array([2.0, -1.0, 2.0]) / 3.0, None if point is None else np.array(point))
    felt, lag, step = list(truth.felt(truth.path("ellipsoid"), 0.5e-3, 1))[:25], 5, 0.01
    T, r, n = (np.array([getattr(s, name) for s in felt]) for name in ("T_base_probe", "r_probe", "n_base"))
    carried = [motion.T_base_carrier(k * step) for k in range(len(felt))]
    halfway = np.array([motion.T_base_carrier((k + lag / 2) * step)[:3, :3] for k in range(len(felt) - lag)])
    in_base = np.array([A @ B for A, B in zip(carried, T, strict=True)])
    n_base = np.array([A[:3, :3] @ b for A, b in zip(carried, n, strict=True)])
    there = paper_rates(in_base, r, n_base, lag, motion.twist(lag * step))
    for seen, rate in zip(there, paper_rates(T, r, n, lag), strict=True):
        assert np.allclose(seen, np.einsum("kij,kj->ki", halfway, rate), atol=4e-4 * np.abs(rate).max())


def test_the_linear_step_shrinks_curvature(truth):
    path = truth.path("cylinder")
    linear, best = [], []
    for seed in range(20):
        p, n = path.noisy(5e-5, 3e-3, seed)
        touches = make_touches(p, n, make_noise(160, 5e-5, 3e-3))
        T, length = working_frame(touches), touches.extent
        d = residuals.design(
            (p - T[:3, 3]) @ T[:3, :3] / length, n @ T[:3, :3], touches.noise.scaled(length, T[:3, :3])
        )
        c = np.linalg.lstsq(*residuals.linear_rows(d), rcond=None)[0]
        linear.append(2 * c[6] / length * R - 1)
        best.append(fit_ml(touches, None).K[0, 0] * R - 1)
    assert np.mean(linear) < -0.04
    assert np.sqrt(np.mean(np.square(linear))) > 2 * np.sqrt(np.mean(np.square(best)))


def test_normal_equations_square_the_condition(truth):
    path = truth.path("cylinder")
    d = residuals.design(path.points, path.normals, make_noise(160, 2e-5, 1e-3))
    A, _ = residuals.linear_rows(d)
    in_metres = np.linalg.cond(A)
    scaled = residuals.design(path.points / 0.01, path.normals, make_noise(160, 2e-3, 1e-3))
    assert in_metres > 100 * np.linalg.cond(residuals.linear_rows(scaled)[0])
    assert np.linalg.cond(A.T @ A) > 1e3 * in_metres
