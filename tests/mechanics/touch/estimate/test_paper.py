"""What is wrong in the paper's scheme, its bias; and its rates."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.mechanics.touch import fit_surface
from canprobe.mechanics.touch.carrier import CarrierMotion
from canprobe.mechanics.touch.estimate.window import paper_rates


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
