"""Fits the noise of the place of a contact, and the lag of the centroid, to touches of known objects."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from canprobe.mechanics.touch.array_calibration.touches import Shown
from canprobe.mechanics.touch.image.calibration import CentroidDelays, ContactNoise, Lag
from canprobe.mechanics.touch.image.pad_lag import PadWay
from canprobe.mechanics.types import Floats

REACH_M, REACH_LOG_SIGMA = 200e-6, 0.2
"""Expected `Lag.reach`, m, and the standard deviation of its logarithm: rolls of one length hardly separate it from
`Lag.most`."""
MAX_SLOW_WAY_M, SLOW_BIN_M = 0.64e-3, 0.04e-3
"""Longest way over the pad over which slow errors are compared, that of the contact in about 15 mm of a scan whose pad
follows the normal; and its steps, m."""
MAX_SLOW_LENGTH_SHARE = 2.0
"""Longest correlation length of slow errors over that way. Where they still grow at its end, nothing says how far."""
SLOW_LAGS = (4, 8, 16, 32, 64, 128)
"""Numbers of images between two centroids that are compared."""
CORRELATED_FRAMES = 20
"""Number of successive images whose centroids have about the same error."""


def _ways(s: Shown) -> Floats:
    """(n, 2) ways of the contact over the pad, m."""
    way = PadWay()
    return np.array([way.step(t, u, v) for t, (u, v) in zip(s.t_s.tolist(), s.raw.tolist(), strict=True)])


def fit_noise(shown: Sequence[Shown], depths: Sequence[Floats]) -> tuple[ContactNoise, CentroidDelays, Floats]:
    """Noise of contacts, delays of the centroid, and the (n,) scatter of the centroids of each touch, m.

    Latency and lag are fitted to the rolls to and fro. The noise from image to image follows from second differences
    of centroids in time, by load; the slow error from what they differ by the more, the further they are apart on the
    pad; that of the height from the way of the probe into the object, less the depth.

    Args:
        shown: the touches.
        depths: (n,) depth in each image of each touch, m.

    Hysteresis lags by a way and latency by a time: in the middle of a stroke the way is the same at any speed, which
    separates them. The rolls are as short as those of a scan: over longer ways the centroid lags further.
    """
    rolls = [s for s in shown if s.dwell.to_and_fro]
    latency, latency_sigma = _latency(rolls)

    # unknowns in 0.1 mm, of about 1: the solver takes its difference step for an unknown of 1 at least
    def left(z: Floats, s: Shown, way: Floats) -> Floats:
        rest: Floats = s.off + 1e-4 * z[0] * way / (np.hypot(*way.T)[:, None] + 1e-4 * abs(z[1]))
        return rest

    taught = [(s, _ways(s)) for s in rolls or shown]

    def residuals(z: Floats) -> Floats:
        each = [left(z, *pair) for pair in taught]
        centred = [1e5 * (r - r.mean(axis=0)).reshape(-1) / math.sqrt(len(r)) for r in each]
        return np.concatenate([*centred, [math.log(abs(z[1]) / (1e4 * REACH_M)) / REACH_LOG_SIGMA]])

    z = least_squares(residuals, np.array([1.0, 1e4 * REACH_M])).x
    most, reach = (1e-4 * z).tolist()
    rest = [left(z, s, _ways(s)) for s in shown]
    # from image to image: second differences of anything slower are nearly 0
    sigma = np.sqrt([np.mean(np.diff(r, 2, axis=0) ** 2) / 6.0 for r in rest])  # 1 + 4 + 1
    power, log_scale = np.polyfit(np.log([s.lightness for s in shown]), np.log(sigma), 1)
    slow, slow_way = _slow(rest, [s.way for s in shown], sigma)
    heights = [np.var(s.pushes - depth) for s, depth in zip(shown, depths, strict=True)]
    noise = ContactNoise(
        scale=math.exp(float(log_scale)),
        power=float(power),
        slow=slow,
        slow_way=slow_way,
        height=math.sqrt(float(np.mean(heights))),
    )
    return noise, CentroidDelays(latency, latency_sigma, Lag(most=max(most, 0.0), reach=abs(reach))), sigma


def _latency(rolls: Sequence[Shown]) -> tuple[float, float]:
    """Age of images at their time stamps, s, and its σ, from the middle of strokes at several speeds."""
    rows = []
    for s in rolls:
        along = s.way - s.way.mean(axis=0)
        axis = int(np.ptp(along[:, 1]) > np.ptp(along[:, 0]))
        way = along[:, axis]
        speed, off = np.gradient(way, s.t_s), s.off[:, axis] - s.off[:, axis].mean()
        middle = np.abs(way) < 0.5 * np.abs(way).max()
        rows += list(zip(np.sign(speed[middle]), speed[middle], off[middle], strict=True))
    if not rows or np.ptp(np.abs([r[1] for r in rows])) == 0.0:
        return 0.0, math.inf
    A, y = np.array(rows)[:, :2], np.array(rows)[:, 2]
    found, *_ = np.linalg.lstsq(A, y, rcond=None)
    scatter = float(np.mean((y - A @ found) ** 2)) * np.linalg.inv(A.T @ A)[1, 1]
    return -float(found[1]), math.sqrt(scatter * CORRELATED_FRAMES)


def _slow(errors: Sequence[Floats], ways: Sequence[Floats], sigma: Floats) -> tuple[float, float]:
    """Standard deviation of the slow part of errors (n, 2), and its correlation length along the pad, m."""
    # half the mean square difference of two errors that are w apart on the pad is the variance from image to image plus
    # `slow² (1 − exp(−w / length))`
    count = round(MAX_SLOW_WAY_M / SLOW_BIN_M)
    sums, pairs = np.zeros(count), np.zeros(count)
    for r, way, noise in zip(errors, ways, sigma, strict=True):
        for lag in SLOW_LAGS:
            place = (np.hypot(*(way[lag:] - way[:-lag]).T) / SLOW_BIN_M).astype(int)
            half = 0.5 * np.mean((r[lag:] - r[:-lag]) ** 2, axis=1) - noise**2
            near = place < count
            sums += np.bincount(place[near], half[near], count)
            pairs += np.bincount(place[near], minlength=count)
    w = SLOW_BIN_M * (np.flatnonzero(pairs) + 0.5)
    D, weight = sums[pairs > 0] / pairs[pairs > 0], np.sqrt(pairs[pairs > 0])

    def residuals(z: Floats) -> Floats:
        rest: Floats = weight * (z[0] ** 2 * (1.0 - np.exp(-w / MAX_SLOW_WAY_M / z[1] ** 2)) - 1e10 * D)
        return rest

    least, most = math.sqrt(SLOW_BIN_M / MAX_SLOW_WAY_M), math.sqrt(MAX_SLOW_LENGTH_SHARE)
    slow, root = least_squares(residuals, np.array([3.0, 1.0]), bounds=([0.0, least], [np.inf, most])).x.tolist()
    return 1e-5 * slow, MAX_SLOW_WAY_M * root**2
