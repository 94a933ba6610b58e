"""Two sheets of one body: a map never states a curvature narrowly that is a mix of both."""

import numpy as np
import pytest

from canprobe import fit_map

RADIUS, SIGMA_POINT, SIGMA_NORMAL = 0.03, 20e-6, 5e-3
PASS = np.column_stack([np.arange(-9e-3, 9e-3, 0.25e-3), np.zeros(72)])
RASTER = np.concatenate([PASS + np.array([0.0, y]) for y in np.arange(-9e-3, 9.1e-3, 3e-3)])
SHEETS = {
    "one over the other": lambda: (RASTER, RASTER + np.array([0.4e-3, 0.7e-3])),
    "step": lambda: (RASTER[RASTER[:, 0] < 1e-3], RASTER[RASTER[:, 0] > 1e-3]),
    "step between two passes": lambda: (PASS, PASS + np.array([0.0, 2e-3])),
    "lap joint": lambda: (RASTER[RASTER[:, 0] < 3e-3], RASTER[RASTER[:, 0] > -1e-3] + [0.0, 1e-3]),
    "terraces": lambda: tuple(RASTER[np.floor(RASTER[:, 0] / 3e-3) == k] for k in range(-3, 3)),
}


@pytest.mark.parametrize(("facing", "gap"), [("same", 1e-3), ("opposite", 0.3e-3)])
@pytest.mark.parametrize("sheets", SHEETS)
def test_two_sheets_make_no_curvature_that_is_stated_narrowly(sheets, facing, gap):
    """Sheets on balls of 30 mm and more; of two that face each other the upper one is seen from inside."""
    rng = np.random.default_rng(0)
    points, normals, kappa = [], [], []
    for k, xy in enumerate(SHEETS[sheets]()):
        up = np.column_stack([xy, np.sqrt(RADIUS**2 - (xy**2).sum(axis=1))]) / RADIUS
        out = -1.0 if facing == "opposite" and k % 2 else 1.0
        points.append((RADIUS + k * gap) * up)
        normals.append(out * up)
        kappa.append(np.full(len(xy), out / (RADIUS + k * gap)))
    p, n, K = (np.concatenate(parts) for parts in (points, normals, kappa))
    found = fit_map(
        p + SIGMA_POINT * rng.normal(size=p.shape),
        n + SIGMA_NORMAL * rng.normal(size=n.shape),
        sigma_point=SIGMA_POINT,
        sigma_normal=SIGMA_NORMAL,
    )
    bent = found.curvature(p)
    stated = np.isfinite(bent.K[:, 0, 0]) & (np.einsum("ni,ni->n", found.normal(p)[0], n) > 0.5)
    off = (bent.K - K[:, None, None] * np.eye(2))[stated][:, [0, 0, 1], [0, 1, 1]]
    chi2 = np.einsum("ni,ni->n", off, np.linalg.solve(bent.covariance[stated], off[..., None])[..., 0])
    assert chi2.max(initial=0.0) < 30.0
