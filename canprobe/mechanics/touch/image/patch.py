"""The contact patch in a tactile image: force and centroid, with what makes them doubtful.

Taxels lie as `touch.pad` says: (u, v) are azimuthal-equidistant on the sphere, so a taxel's true area is
`pitch² · sin(ρ)/ρ` with ρ = √(u² + v²)/R_p.

This is the *inverse* of a sensor. It shares nothing with the models that make images; its constants come from a
calibration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import UsageError
from canprobe.mechanics.touch.checks import checked, positive, read_only
from canprobe.mechanics.touch.contact import Doubt
from canprobe.mechanics.touch.image.force_errors import UNSTATED, ForceErrors, ForceSigma
from canprobe.mechanics.touch.image.silent_taxels import mended
from canprobe.mechanics.touch.pad import COUNTS_MAX, THRESHOLD_COUNTS, Pad
from canprobe.mechanics.touch.stops import OFF_PAD_ACROSS_SHARE, OFF_PAD_EDGE_SHARE, OFF_PAD_SIGMAS, OFF_PAD_TAXELS
from canprobe.mechanics.types import Floats

_MIN_TAXELS = 4
"""Least number of active taxels of a patch with usable moments."""
_ALL_COUNTS = bytes(range(COUNTS_MAX + 1))
MAX_EDGE_SHARE = 0.1
"""Largest pressure at the window's edge, over the peak, of a patch that ends within the next taxel."""
MIN_PEAK_RATIO = 3
"""Peak count over the threshold that must be exceeded for an extrapolation. Below it whole counts and noise hide the
shape: the trace that creep leaves of a long press was extrapolated to up to five times its force."""
MIN_FITTED_SHARE = 0.2
"""Least pressure of a taxel in the fit, over the peak: blur and threshold bend the rim."""
MIN_FITTED_TAXELS = 12
"""Least number of taxels in the fit: twice the six unknowns."""
MIN_FALL_SHARE = 0.3
"""Least fall of the pressure over half the pad, over the peak, in every direction; with less there is no patch."""


class FeaturesLike(Protocol):
    """Moments as a sensor node computes them: force in N, places in taxels (row, column), peak in counts."""

    @property
    def force_n(self) -> float: ...
    @property
    def row(self) -> float: ...
    @property
    def col(self) -> float: ...
    @property
    def var_rr(self) -> float: ...
    @property
    def var_cc(self) -> float: ...
    @property
    def peak(self) -> float: ...


class Patch(NamedTuple):
    """What one image says about the contact.

    Attributes:
        force: force, N, corrected by the calibration.
        u, v: centroid of pressure on the pad, m; NaN without contact.
        n_active: number of taxels at or above the threshold; −1 where only features were sent.
        peak_pa: highest taxel pressure, Pa.
        saturated: whether a taxel is at its largest count.
        cut_by_window: pressure at an edge of the window inside the pad, over the peak; force and centroid include an
            extrapolation beyond it (`Continuation`).
        cut_by_pad: whether the patch reaches the pad's edge.
        too_few: whether fewer than four taxels are active, too few for moments.
        dead: number of taxels inside the patch that do not measure, bridged by their neighbours (`mended`,
            `silent_taxels`).
        off_pad: whether the pressure is highest at the pad's edge, or half of it at two opposite edges: a sixth of the
            contact or more lies beyond, and the force is only a lower bound.
        bridged: share of the force that taxels would measure which do not, interpolated.
        sigma: standard deviation of the force by its causes; of a single image, whose age in the touch is not known, 0.
    """

    force: float
    u: float
    v: float
    n_active: int
    peak_pa: float
    saturated: bool
    cut_by_window: float
    cut_by_pad: bool
    too_few: bool
    dead: int = 0
    off_pad: bool = False
    bridged: float = 0.0
    sigma: ForceSigma = ForceSigma()

    @property
    def good(self) -> bool:
        """Whether nothing makes the centroid doubtful."""
        return not (self.saturated or self.cut_by_window or self.cut_by_pad or self.too_few or self.dead)

    @property
    def doubts(self) -> tuple[Doubt, ...]:
        """Doubts that an estimator takes into account."""
        said = (
            (Doubt.SATURATED, self.saturated),
            (Doubt.CUT, self.cut_by_pad),
            (Doubt.SMALL, self.too_few),
            (Doubt.DEAD, self.dead > 0),
        )
        return tuple([doubt for doubt, holds in said if holds])


class Continuation:
    """Extrapolates the pressure beyond the windows of one array.

    A window of 8 × 8 taxels cuts the patch of a soft contact, and force and centroid are wrong by the part outside. On
    a bed of springs the pressure is a quadratic function of the place, so the rest of the patch follows from the part
    that is seen: a quadratic is fitted to the well pressed taxels and evaluated outside the window where it is above
    zero. On the emulated array the force is then 2 % low at 4 kN/m instead of 3–11 %, and the centroid 0.09 mm off
    instead of 0.2–0.4 mm. It stops being true where the curvature of the object changes within the patch.

    Source: Johnson, Contact Mechanics (1985), 4.3, the elastic foundation.

    Args:
        weights: (n², 6) area of each taxel × (1, u, v, uu, uv, vv), the place in any unit.
        saturated_pa: pressure of a saturated taxel, Pa, which is left out of the fit.
    """

    def __init__(self, weights: Floats, saturated_pa: float) -> None:
        self._saturated_pa = saturated_pa
        self._weights = weights
        self._area = weights[:, 0].copy()
        self._terms = weights / weights[:, :1]
        self._corner = float(self._terms[-1, 3])

    def completed(self, pressure: Floats, window: Sequence[int], peak_pa: float) -> Floats:
        """The pressures of the whole pad, those outside the window extrapolated from those inside.

        Args:
            pressure: (n, n) pressures of the taxels, Pa; 0 outside the window.
            window: first row, first column, rows, columns.
            peak_pa: highest of the pressures, Pa.

        Returns:
            A completed copy (n, n), Pa; the same array where the taxels do not fit a quadratic with a summit.
        """
        row, column, rows, columns = window
        width = pressure.shape[1]
        strip = slice(width * row, width * (row + rows))  # the rows of the window: all else is 0
        seen = pressure.reshape(-1)[strip]
        used = (seen >= MIN_FITTED_SHARE * peak_pa) & (seen < self._saturated_pa)
        if np.count_nonzero(used) < MIN_FITTED_TAXELS:
            return pressure
        weights = self._weights[strip]
        used_weights = (weights * used[:, None]).T
        try:
            # why not lstsq: it takes twice as long, for digits that counts do not have
            quadratic = np.linalg.solve(used_weights.dot(weights), used_weights.dot(self._area[strip] * seen))
        except np.linalg.LinAlgError:
            return pressure
        _, _, _, uu, uv, vv = quadratic.tolist()
        least_fall = -0.5 * (uu + vv + math.hypot(uu - vv, uv)) * self._corner
        if not least_fall > MIN_FALL_SHARE * peak_pa:
            return pressure
        whole: Floats = np.maximum(self._terms.dot(quadratic), 0.0).reshape(pressure.shape)
        inside = slice(row, row + rows), slice(column, column + columns)
        whole[inside] = pressure[inside]
        return whole


@dataclass(frozen=True, slots=True, eq=False)
class PatchCalibration:
    """From counts to pascals and from the pressure sum to force.

    The pressure of a taxel is `full_scale_pa · counts / 255`. The force is `force_gain · S + edge_gain · √(S · 1 N)`
    with S the sum of pressure times area; the second term stands for what the patch loses at its rim under the
    threshold. Both gains follow from the image model (`image_model.make_patch_calibration`).

    Attributes:
        pad: the taxels, with their pressure at the largest count.
        threshold_counts: least count that is not taken as 0.
        force_gain: gain of the pressure sum.
        edge_gain: gain of its root, √N.
        gains: (rows, columns) gains of the taxels over their mean; empty where all are alike.
        dead: (row, column) of each taxel that is known to read nothing.
        blur_m: standard deviation of the blur by the cover, m; 0 where it is not known.
        force_errors: errors of the force.
        reference_sigma: relative standard deviation of the reference of newtons; 0 where there is none.
        pascals: (256,) pressure of each count, Pa.
        weights: (n, 6) area × (1, u, v, uu, uv, vv) of each taxel over its gain, lengths in pitches, the area in m².
        continuation: extrapolation beyond a window.
    """

    pad: Pad = field(default_factory=Pad)
    threshold_counts: int = THRESHOLD_COUNTS
    force_gain: float = 1.0
    edge_gain: float = 0.0
    gains: tuple[tuple[float, ...], ...] = ()
    dead: tuple[tuple[int, int], ...] = ()
    blur_m: float = 0.0
    force_errors: ForceErrors = UNSTATED
    reference_sigma: float = 0.0
    pascals: Floats = field(init=False, repr=False)
    weights: Floats = field(init=False, repr=False)
    continuation: Continuation = field(init=False, repr=False)

    def __post_init__(self) -> None:
        positive("force_gain", self.force_gain)
        counts = np.arange(256.0)
        pascals = self.pad.full_scale_pa * (counts / COUNTS_MAX)
        pascals[counts < self.threshold_counts] = 0.0
        object.__setattr__(self, "pascals", read_only(pascals))
        u, v = self.pad.uv.T / self.pad.pitch_m
        moments = np.ones_like(u), u, v, u * u, u * v, v * v
        weights = np.stack([self.pad.areas * moment for moment in moments], axis=-1)
        object.__setattr__(self, "continuation", Continuation(weights, float(pascals[COUNTS_MAX])))
        if self.gains:
            weights = weights / checked("gains", self.gains, self.pad.shape).reshape(-1, 1)
        object.__setattr__(self, "weights", read_only(weights))


def compute_patch(
    taxels: NDArray[np.uint8], calibration: PatchCalibration, window: Sequence[int] | None = None
) -> Patch:
    """Patch of an image; without an active taxel its force is 0 and its centroid NaN.

    Args:
        taxels: (rows, columns) uint8 counts in pad coordinates, zeros outside the window.
        calibration: calibration of the array.
        window: first row, first column, rows, columns that were sent; None for the whole pad.

    Raises:
        UsageError: the image does not have the shape of the calibration's pad, or is not uint8.
    """
    pad = calibration.pad
    if taxels.shape != pad.shape or taxels.dtype != np.uint8:
        raise UsageError(f"taxels: expected {pad.shape} uint8, got {taxels.shape} {taxels.dtype}")
    dead = 0
    if pad.is_grid:  # the taxels of a list have no neighbours
        taxels, dead = mended(taxels)
    counts = taxels.tobytes()
    # bytes and no arrays: number and peak of the active taxels take 3 instead of 8 µs
    active = counts.translate(None, _ALL_COUNTS[: max(calibration.threshold_counts, 1)])
    if not active:
        return _nothing(0.0)._replace(dead=dead)
    edges = _edges(counts, pad.shape, window) if pad.is_grid else (*_rim(taxels, pad), 0)
    n_active, peak = len(active), max(active)
    pascals = calibration.pascals
    peak_pa, at_pad, across, at_window = [pascals.item(count) for count in (peak, *edges)]
    pressure = pascals.take(taxels)
    shows_shape = peak > MIN_PEAK_RATIO * calibration.threshold_counts
    if window is not None and at_window > MAX_EDGE_SHARE * peak_pa and shows_shape:
        pressure = calibration.continuation.completed(pressure, window, peak_pa)
    total, u, v, *_ = pressure.reshape(-1).dot(calibration.weights).tolist()
    if total <= 0.0:
        return _nothing(peak_pa)._replace(dead=dead)
    return Patch(
        *_force_and_centroid(total, u / total, v / total, calibration),
        n_active=n_active,
        peak_pa=peak_pa,
        saturated=peak >= COUNTS_MAX,
        cut_by_window=at_window / peak_pa,
        cut_by_pad=at_pad > 0.0,
        too_few=n_active < _MIN_TAXELS,
        dead=dead,
        off_pad=at_pad >= OFF_PAD_EDGE_SHARE * peak_pa or across >= OFF_PAD_ACROSS_SHARE * peak_pa,
    )


def _nothing(peak_pa: float) -> Patch:
    return Patch(0.0, math.nan, math.nan, 0, peak_pa, False, 0.0, False, True)


def _force_and_centroid(total: float, u: float, v: float, calibration: PatchCalibration) -> tuple[float, float, float]:
    """Force (N) of a sum of pressure times area (N), and the centroid (m) of one in pitches."""
    force = calibration.force_gain * total + calibration.edge_gain * math.sqrt(total)
    return force, u * calibration.pad.pitch_m, v * calibration.pad.pitch_m


def _edges(counts: bytes, shape: tuple[int, int], window: Sequence[int] | None) -> tuple[int, int, int]:
    """Highest count at the pad's edge, what two opposite edges both have, and that at edges of a window in the pad."""
    height, width = shape
    top, bottom, left, right = counts[:width], counts[-width:], counts[::width], counts[width - 1 :: width]
    sides = [max(side.strip(b"\0"), default=0) for side in (top, bottom, left, right)]  # mostly nothing is left
    at_pad, across = max(sides), max(min(sides[:2]), min(sides[2:]))
    if window is None:
        return at_pad, across, 0
    r0, c0, n_rows, n_cols = window
    inside = b""
    for row in (r0, r0 + n_rows - 1):
        if 0 < row < height - 1:
            inside += counts[width * row : width * (row + 1)]
    for column in (c0, c0 + n_cols - 1):
        if 0 < column < width - 1:
            inside += counts[column::width]
    return at_pad, across, max(inside, default=0)


def _rim(taxels: NDArray[np.uint8], pad: Pad) -> tuple[int, int]:
    """Highest count at the edge of a list of taxels, and what two opposite sides of it both have."""
    sides = np.where(pad.sides, taxels.reshape(-1), 0).max(axis=1)
    half = len(sides) // 2
    return int(sides.max(initial=0)), int(np.minimum(sides[:half], sides[half:]).max(initial=0))


def patch_from_features(features: FeaturesLike, calibration: PatchCalibration) -> Patch:
    """Patch from moments that the sensor node computed itself.

    The node's force is its plain sum of pressure times area; the calibration's gains are applied here. Moments do not
    show a cut: `cut_by_pad` is set where two standard deviations reach past the pad, `off_pad` where `OFF_PAD_SIGMAS`
    do or the centroid lies in the last row of taxels.

    Args:
        features: force in N, row and column in taxels, variances in taxels², peak in counts.
        calibration: calibration of the array.
    """
    rows, columns = calibration.pad.shape
    row, col = features.row - (rows - 1) / 2, features.col - (columns - 1) / 2
    total = max(features.force_n, 0.0)
    axes = ((abs(row) - 0.5 * rows, features.var_rr), (abs(col) - 0.5 * columns, features.var_cc))  # from the edge
    cut_by_pad = any(c + 2.0 * math.sqrt(max(var, 0.0)) > 0.0 for c, var in axes)
    # 1/12: variance of the pressure within a taxel
    reached = max(c + OFF_PAD_SIGMAS * math.sqrt(max(var, 0.0) + 1.0 / 12.0) for c, var in axes)
    at_edge = max(c for c, _ in axes) > -OFF_PAD_TAXELS
    peak = min(max(int(features.peak), 0), COUNTS_MAX)
    peak_pa = float(calibration.pascals[peak])
    if total <= 0.0:
        return _nothing(peak_pa)
    return Patch(
        *_force_and_centroid(total, col, row, calibration),
        n_active=-1,
        peak_pa=peak_pa,
        saturated=peak >= COUNTS_MAX,
        cut_by_window=0.0,
        cut_by_pad=cut_by_pad,
        too_few=False,
        off_pad=reached > 0.0 or at_edge,
    )
