"""The blur of an array, and the bend of the pressure, by one image, whatever lies under the probe.

On a Winkler layer the pressure of a patch is a paraboloid, `(P − xᵀ A x)₊`. The cover blurs it, which its rim shows:
no P and A give the same image with another blur. So seven unknowns are fitted to the taxels: P, the place, A and the
blur. Gains, crosstalk and level are those of the calibration.

It is not true where taxels saturate, at the pad's edge, and where the patch is no paraboloid (an edge of the object);
there the fit leaves a large residual, and gives nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.pad import THRESHOLD_COUNTS
from canprobe.mechanics.types import Floats

STEPS_PER_PITCH = 3
"""Grid points in a pitch, as in `image_model`."""
MARGIN_PITCHES = 2
"""Width of the grid beyond the taxels, pitches."""
COUNT_SIGMA, RELATIVE_SIGMA = 1.3, 0.03
"""Standard deviation of a taxel: its noise in counts, and what gains, hysteresis and the form of the patch do."""
MAX_CHI2 = 4.0
"""Largest mean square residual, in these standard deviations, of an image that shows a patch of this form."""
MIN_TAXELS = 12
"""Least number of active taxels: five more than unknowns."""
MAX_STEPS, LAST_STEP = 12, 1e-2
"""Most Gauss–Newton steps, and the relative step of the blur that ends them."""
MAX_STEP, MAX_PEAK_STEP = 0.3, 0.5
"""Largest relative steps of the blur and of P."""
MIN_BLUR, MAX_BLUR = 0.2, 2.0
"""Blur in pitches that an image can show: less is lost between the taxels, more in the patch."""
_DIFFERENCE_STEP = 1e-3


class FittedImage(NamedTuple):
    """What an image shows of its array.

    Attributes:
        blur: standard deviation of the blur, pitches.
        bend: mean fall of the pressure over the square of the way from its peak, tr A / 2, counts per pitch²: the
            stiffness of the layer times the mean curvature of probe and object, in these units.
    """

    blur: float
    bend: float


def fit_blur(
    image: NDArray[np.uint8],
    window: Sequence[int],
    *,
    blur: float,
    crosstalk: float,
    gains: Floats,
) -> FittedImage | None:
    """The blur of an image; None where the image does not show it.

    Args:
        image: (rows, columns) counts.
        window: first row, first column, rows, columns that were sent.
        blur: blur to start from, pitches.
        crosstalk: share of a taxel's signal that spreads over its row, and again over its column.
        gains: (rows, columns) gains of the taxels.
    """
    part = _active_part(image, window)
    counts = image[part].astype(np.float64)
    if np.count_nonzero(counts) < MIN_TAXELS:
        return None
    active, gain = counts > 0.0, gains[part]
    sigma = np.hypot(COUNT_SIGMA, RELATIVE_SIGMA * counts)
    share = crosstalk / (max(image.shape) - 1)

    def residuals(z: Floats) -> Floats:
        """(n, taxels) of each row of unknowns (n, 7); a taxel without a count is one below the threshold."""
        shown = gain * _images(z, counts.shape, share, max(image.shape))
        off = np.where(active, shown - counts, np.maximum(shown - THRESHOLD_COUNTS, 0.0)) / sigma
        return off.reshape(len(z), -1)

    z = _start(counts, blur)
    if z is None:
        return None
    for _ in range(MAX_STEPS):
        steps = _DIFFERENCE_STEP * np.array([z[0], 1.0, 1.0, *[z[3] + z[5]] * 3, z[6]])
        r = residuals(np.concatenate([z[None], z + np.diag(steps)]))
        J = (r[1:] - r[0]) / steps[:, None]
        try:
            way = np.linalg.solve(J @ J.T, -J @ r[0])
        except np.linalg.LinAlgError:
            return None
        longest = max(abs(float(way[6] / z[6])) / MAX_STEP, abs(float(way[0] / z[0])) / MAX_PEAK_STEP, 1.0)
        z = z + way / longest
        if not (MIN_BLUR < z[6] < MAX_BLUR and z[0] > 0.0):
            return None
        if abs(way[6]) < LAST_STEP * z[6]:
            chi2 = float(r[0] @ r[0]) / max(int(np.count_nonzero(active)) - len(z), 1)
            return FittedImage(float(z[6]), 0.5 * float(z[3] + z[5])) if chi2 < MAX_CHI2 else None
    return None


def _active_part(image: NDArray[np.uint8], window: Sequence[int]) -> tuple[slice, slice]:
    """Rows and columns of the active taxels and one more on each side, inside the window."""
    parts = []
    for axis, (first, count) in enumerate((window[0::2], window[1::2])):
        places = np.flatnonzero(image.any(axis=1 - axis))
        low, high = (int(places[0]), int(places[-1])) if len(places) else (first, first)
        parts.append(slice(max(low - 1, first), min(high + 2, first + count)))
    return parts[0], parts[1]


def _start(counts: Floats, blur: float) -> Floats | None:
    """Unknowns (7,) from the moments of the counts: P, place x, y, A11, A12, A22, blur; in counts and pitches."""
    total = counts.sum()
    y, x = np.indices(counts.shape)
    cx, cy = (counts * x).sum() / total, (counts * y).sum() / total
    dx, dy = x - cx, y - cy
    V = np.array([[(counts * a * b).sum() / total for a in (dx, dy)] for b in (dx, dy)]) - 0.5 * blur**2 * np.eye(2)
    if not (V[0, 0] > 0.0 and V[0, 0] * V[1, 1] > V[0, 1] ** 2):
        return None
    peak = 1.1 * counts.max()
    # the moments of a paraboloid are (P/6) A⁻¹; of the blur a half is off, as in `ImageModel.start`
    A = np.linalg.inv(V) * peak / 6.0
    return np.array([peak, cx, cy, A[0, 0], A[0, 1], A[1, 1], blur])


def _images(z: Floats, shape: tuple[int, ...], share: float, side: int) -> Floats:
    """(n, rows, columns) counts for each row of unknowns (n, 7)."""
    (rows, columns), (P, x, y, a, b, c, blur) = shape, (part[:, None, None] for part in z.T)
    across, down = (_grid(taxels) for taxels in (columns, rows))
    X, Y = across - x, down[:, None] - y
    field = np.maximum(P - a * X * X - 2.0 * b * X * Y - c * Y * Y, 0.0)
    left, right = (_blurred(taxels, grid, blur, share, side) for taxels, grid in ((rows, down), (columns, across)))
    images: Floats = left @ field @ right.transpose(0, 2, 1)
    return images


def _grid(taxels: int) -> Floats:
    """Places of the grid points along a side with a number of taxels, pitches."""
    return (
        np.arange(-MARGIN_PITCHES * STEPS_PER_PITCH, (taxels + MARGIN_PITCHES) * STEPS_PER_PITCH) + 0.5
    ) / STEPS_PER_PITCH - 0.5


def _blurred(taxels: int, grid: Floats, blur: Floats, share: float, side: int) -> Floats:
    """(n, taxels, grid) weights of the grid points in the taxels of a row: blur, then crosstalk."""
    off = (np.arange(taxels)[:, None] - grid) / blur
    weights: Floats = np.exp(-0.5 * off * off) / (STEPS_PER_PITCH * math.sqrt(2.0 * math.pi) * blur)
    return (1.0 - side * share) * weights + share / STEPS_PER_PITCH
