"""What is plotted over time: force, principal curvatures with their bands, the error of the curvature."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from canprobe.bridge.sample import SurfacePatch
from canprobe.bridge.view.meshes import Array
from canprobe.bridge.view.moments import Moment

NAMES = ("t_s", "force", "kappa1", "low1", "high1", "kappa2", "low2", "high2", "error", "sigma")


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """Columns of one length; NaN where there is nothing to plot.

    Attributes:
        columns: by the names of `NAMES`; s, N, 1/m; low and high are the ends of the 95 % bands.
    """

    columns: dict[str, Array]

    def __getitem__(self, name: str) -> Array:
        return self.columns[name]


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
    nan = math.nan
    if moment.patch is None:
        bands: tuple[float, ...] = (nan,) * 6
    else:
        kappa, sigmas = moment.patch.kappa, kappa_sigmas(moment.patch)
        bands = tuple(
            x
            for k, s in zip(kappa, sigmas, strict=True)
            for x in ((k, k - 1.96 * s, k + 1.96 * s) if math.isfinite(s) else (k, nan, nan))
        )
    sigma = moment.sigma if math.isfinite(moment.sigma) else nan
    return (moment.t_s, moment.force, *bands, moment.error, sigma)


def curves_of(moments: Iterable[Moment]) -> Curves:
    """Columns of a run's moments."""
    rows = np.array([row_of(moment) for moment in moments], dtype=np.float64).reshape(-1, len(NAMES))
    return Curves(dict(zip(NAMES, rows.T, strict=True)))
