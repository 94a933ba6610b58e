"""Fits the lag and the scatter of centroids, and the way over which an error of a centroid lasts."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from canprobe.mechanics.touch.patch.array_calibration import CentroidErrors, Lag
from canprobe.mechanics.touch.patch.image_fit import Dwell, Shown
from canprobe.mechanics.types import Floats

REACH_M, REACH_LOG_SIGMA = 200e-6, 0.2
"""Expected `Lag.reach`, m, and the standard deviation of its logarithm: rolls of one length hardly separate it from
`Lag.most`."""
SCATTER_WAY_M = 1e-3
"""Way over the pad within which centroids scatter as their noise: 20 mm of a scan whose pad follows the normal."""
CORRELATED_FRAMES = 20
"""Number of successive images whose centroids have about the same error."""
LAG_STEPS, LAG_STEP_M = 16, 1e-4
"""Number and length (m) of the steps of the autocorrelation along the way over the pad."""
TIME_CONSTANTS_S = 0.02, 0.3
"""Time constants `Lag.quick_s` and `Lag.slow_s`, s."""


def _means(t: Floats, at: Floats) -> Floats:
    """(n, 2) ways from the slow to the quick exponential mean of places (n, 2), as `PadLag` computes them."""
    quick = slow = at[0]
    ways = np.zeros_like(at)
    for i in range(1, len(t)):
        dt = t[i] - t[i - 1]
        quick = quick + (1.0 - math.exp(-dt / TIME_CONSTANTS_S[0])) * (at[i] - quick)
        slow = slow + (1.0 - math.exp(-dt / TIME_CONSTANTS_S[1])) * (at[i] - slow)
        ways[i] = quick - slow
    return ways


def fit_centroids(dwells: Sequence[Dwell], shown: Sequence[Shown]) -> tuple[CentroidErrors, Floats]:
    """Errors of centroids, and the (n,) scatter of the centroids of each touch, m.

    Latency and lag are fitted to the rolls to and fro; then the scatter of all touches by load, and its correlation.

    Hysteresis lags by a way and latency by a time: in the middle of a stroke the way is the same at any speed, which
    separates them. The rolls are as short as those of a scan: over longer ways the centroid lags further.
    """
    rolls = [s for d, s in zip(dwells, shown, strict=True) if d.to_and_fro]
    latency, latency_sigma = _latency(rolls)

    def left(z: Floats, s: Shown, way: Floats) -> Floats:
        rest: Floats = s.off + 1e-4 * z[0] * way / (np.hypot(*way.T)[:, None] + 1e-4 * abs(z[1]))
        return rest

    taught = [(s, _means(s.t_s, s.raw)) for s in rolls or shown]

    def residuals(z: Floats) -> Floats:
        each = [left(z, *pair) for pair in taught]
        centred = [1e5 * (r - r.mean(axis=0)).reshape(-1) / math.sqrt(len(r)) for r in each]
        return np.concatenate([*centred, [math.log(abs(z[1]) / (1e4 * REACH_M)) / REACH_LOG_SIGMA]])

    z = least_squares(residuals, np.array([1.0, 1e4 * REACH_M])).x
    most, reach = (1e-4 * z).tolist()
    rest = [left(z, s, _means(s.t_s, s.raw)) for s in shown]
    sigma = [_scatter(r, s.way) for r, s in zip(rest, shown, strict=True)]
    power, log_scale = np.polyfit(np.log([s.lightness for s in shown]), np.log(sigma), 1)
    share, length = _lasting(rest, [s.way for s in shown])
    found = CentroidErrors(
        scale=math.exp(float(log_scale)),
        power=float(power),
        correlation=length,
        share=share,
        latency_s=latency,
        latency_sigma_s=latency_sigma,
        lag=Lag(most=max(most, 0.0), reach=abs(reach)),
    )
    return found, np.array(sigma)


def _along(way: Floats) -> Floats:
    """(n,) path over the pad, m, up to each of its places (n, 2)."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])


def _scatter(r: Floats, way: Floats) -> float:
    """Standard deviation of errors (n, 2) within `SCATTER_WAY_M`: what lasts longer bends no surface."""
    part = (_along(way) / SCATTER_WAY_M).astype(int)
    variances = [r[part == i].var(axis=0, ddof=1).mean() for i in range(part[-1] + 1) if np.sum(part == i) > 4]
    return math.sqrt(float(np.mean(variances))) if variances else float(r.std())


def _latency(rolls: Sequence[Shown]) -> tuple[float, float]:
    """Age of images at their time stamps, s, and its σ, from the middle of strokes at several speeds."""
    rows = []
    for s in rolls:
        along = s.way - s.way.mean(axis=0)
        way = along[:, int(np.ptp(along[:, 1]) > np.ptp(along[:, 0]))]
        axis = int(np.ptp(along[:, 1]) > np.ptp(along[:, 0]))
        speed, off = np.gradient(way, s.t_s), s.off[:, axis] - s.off[:, axis].mean()
        middle = np.abs(way) < 0.5 * np.abs(way).max()
        rows += list(zip(np.sign(speed[middle]), speed[middle], off[middle], strict=True))
    if not rows or np.ptp(np.abs([r[1] for r in rows])) == 0.0:
        return 0.0, math.inf
    A, y = np.array(rows)[:, :2], np.array(rows)[:, 2]
    found, *_ = np.linalg.lstsq(A, y, rcond=None)
    scatter = float(np.mean((y - A @ found) ** 2)) * np.linalg.inv(A.T @ A)[1, 1]
    return -float(found[1]), math.sqrt(scatter * CORRELATED_FRAMES)


def _lasting(errors: Sequence[Floats], ways: Sequence[Floats]) -> tuple[float, float]:
    """Share of the variance of errors (n, 2) that lasts along the way over the pad, and over which length, m."""
    lags = np.zeros(LAG_STEPS)
    for r, way in zip(errors, ways, strict=True):
        s = _along(way)
        grid = np.arange(0.0, s[-1], LAG_STEP_M)
        if len(grid) < 2 * LAG_STEPS:
            continue
        on_grid = np.stack([np.interp(grid, s, r[:, i]) for i in (0, 1)])
        on_grid -= on_grid.mean(axis=1, keepdims=True)
        lags += [float((on_grid[:, : len(grid) - k] * on_grid[:, k:]).mean()) for k in range(LAG_STEPS)]
    if lags[0] <= 0.0:
        return 0.0, LAG_STEP_M
    # the mean of each error was subtracted, which shifts the whole autocorrelation down
    at = LAG_STEP_M * np.arange(1, LAG_STEPS)

    def residuals(z: Floats) -> Floats:
        rest: Floats = z[0] * np.exp(-at / abs(z[1]) / 1e-3) - z[2] - lags[1:] / lags[0]
        return rest

    share, length, shift = least_squares(residuals, np.array([0.5, 1.0, 0.1])).x.tolist()
    return min(max(share / (1.0 + max(shift, 0.0)), 0.0), 1.0), abs(length) * 1e-3
