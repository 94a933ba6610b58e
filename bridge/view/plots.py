"""Curves over time: force, principal curvatures with their bands, the error of the curvature."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from canprobe.lab.bridge.sample import SurfacePatch
from canprobe.lab.bridge.view.instants import Moment
from canprobe.mechanics.types import Floats

NAMES = ("t_s", "force", "kappa1", "low1", "high1", "kappa2", "low2", "high2", "true1", "true2", "error", "sigma")
Curves = dict[str, Floats]
"""Columns by the names of `NAMES`; s, N, 1/m; low and high are the ends of the 95 % bands; NaN: nothing to plot."""


def kappa_sigmas(patch: SurfacePatch) -> tuple[float, float]:
    """Stated standard deviations of κ1 ≥ κ2, 1/m; infinite where not observed."""
    if not np.isfinite(patch.covariance).all() or not np.isfinite(patch.K).all():
        return math.inf, math.inf
    _, vectors = np.linalg.eigh(patch.K)
    out = []
    for u, v in vectors.T[::-1]:
        g = np.array((u * u, 2.0 * u * v, v * v))
        out.append(math.sqrt(max(float(g @ patch.covariance @ g), 0.0)))
    return out[0], out[1]


def row_of(moment: Moment) -> tuple[float, ...]:
    """One row of the plots, in the order of `NAMES`."""
    nan, answer = math.nan, moment.answer
    if answer is None:
        return (moment.t_s, moment.force, *(nan,) * (len(NAMES) - 2))
    kappa, sigmas = answer.patch.kappa, kappa_sigmas(answer.patch)
    bands = (
        x
        for k, s in zip(kappa, sigmas, strict=True)
        for x in ((k, k - 1.96 * s, k + 1.96 * s) if math.isfinite(s) else (k, nan, nan))
    )
    sigma = answer.sigma if math.isfinite(answer.sigma) else nan
    return (moment.t_s, moment.force, *bands, *answer.kappa_true, answer.error, sigma)


def curves_of(rows: Iterable[tuple[float, ...]]) -> Curves:
    """Columns of rows from `row_of`."""
    columns = np.array(list(rows), dtype=np.float64).reshape(-1, len(NAMES)).T
    return dict(zip(NAMES, columns, strict=True))
