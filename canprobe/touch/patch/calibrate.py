"""Fit an array's calibration to touches of a plane and a ball that were rolled to and fro.

What is known of a touch is the curvature of the object and where on the pad it should lie; what is sought is what makes
the images (`ImageParameters`), how far centroids are off, and the layer's stiffness. The force of a touch is an unknown
of its own, but for a few whose force something else measured: the reference. Without any the scale of the force is a
guess, and stiffness goes with it.

Three of the parameters are hardly told apart by planes and balls alone: blur, crosstalk and memory carry a weak prior
of what arrays of films and foams are like. The arm's way into the object is used for one thing only: the stiffness that
it shows beside that of the images.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from canprobe.errors import UsageError
from canprobe.touch.contact import indentation_from_force
from canprobe.touch.linear_algebra import Array
from canprobe.touch.pad import Pad
from canprobe.touch.patch.array_calibration import (
    ArrayCalibration,
    CentroidErrors,
    ForceReference,
    ImageParameters,
    Lag,
    MomentErrors,
    Residuals,
    StiffnessSources,
)
from canprobe.touch.patch.image import Image, PatchCalibration, compute_patch
from canprobe.touch.patch.image_model import (
    STEPS,
    USUAL_LIGHTNESS,
    ImageModel,
    make_image_model,
    make_patch_calibration,
)
from canprobe.touch.patch.moments import LEVEL_COUNTS, MomentImage, PadMemory

BLUR_PITCH = (0.7, 0.2)
CROSSTALK = (0.025, 0.01)
MEMORY = (0.03, 0.02)
"""Mean and standard deviation of what is expected of any array."""
TOUCH_SIGMA = 0.012
"""Relative error of moments and sums of a touch: gains, hysteresis and creep."""
FORM_SIGMA = 0.01
"""Relative error of a moment that planes and balls do not show: of cylinders and saddles, by the model's form."""
SETTLED_S, AGE_S = 0.5, 3.5
"""From the touch to the first image that counts, and to the last: all touches are compared after as much creep."""
MOST_OF_FULL_SCALE = 0.7
"""Peak over full scale above which a touch is left out: taxels bend off before they saturate."""
HOLLOWEST = -0.9
"""Least curvature that is looked for, over that of the probe."""
FOLDS = 5
LEAST_TOUCHES = 10
HELPFUL = 0.9
"""Share of the moments' error that may be left with gains of the taxels, for these to be used."""
REACH = 200e-6, 0.2
"""Expected `Lag.reach`, m, and how far its logarithm may be off: rolls of one length hardly tell it from `Lag.most`."""
SCATTER_WAY_M = 1e-3
"""Way over the pad within which centroids scatter as their noise: 20 mm of a scan whose pad follows the normal."""
FRAMES_ALIKE = 20
"""Images in a row whose centroids err alike, about."""
LAGS, LAG_STEP_M = 16, 1e-4
"""Of the autocorrelation along the way over the pad."""
TAU_S = 0.02, 0.3
"""Time constants of `Lag`."""


@dataclass(frozen=True, slots=True, eq=False)
class Dwell:
    """One touch of a known object, pressed and rolled.

    Attributes:
        name: of the object: "plane", "ball", "rod".
        kappa: principal curvatures of the object, larger first, 1/m.
        angle: direction of the first on the pad, from u, rad.
        place: number of the place that is touched; touches at one place differ in force only.
        t_s: (n,) time stamps of the images, s.
        images: (n) of them, (16, 16) counts, 0 outside the window.
        windows: (n) first row, first column, rows, columns; None for whole images.
        expected: (n, 2) where the contact lies on the pad by joints and object, m.
        push: (n,) way of the probe's centre towards the object, from any zero, m.
        turn: of the probe about its pole, against the first touch, rad.
        force: reference force, N; None where nothing measured it.
        to_and_fro: it rolls along one line, slowly and then fast; else an eight.
    """

    name: str
    kappa: tuple[float, float]
    angle: float
    place: int
    t_s: Array
    images: Sequence[Image]
    windows: Sequence[Sequence[int]] | None
    expected: Array
    push: Array
    turn: float = 0.0
    force: float | None = None
    to_and_fro: bool = False


class Shown(NamedTuple):
    """What the images of a dwell show, averaged; moments in the object's principal axes, m².

    Attributes:
        total: pressure times area, N.
        crept: the same over the whole touch, over `total`.
        moments, remembered: (3,) xx, xy, yy of the image, and of the ways that the pad remembers.
        frame_sigma: relative standard deviation of a moment from frame to frame.
        lightness: level over peak pressure.
        off: (n, 2) centroids less their expected places, m.
        way: (n, 2) expected places, m.
        t_s: (n,) s.
        raw: (n, 2) centroids, m.
        usable: neither saturated nor off the pad.
        push: mean, m.
    """

    total: float
    crept: float
    moments: Array
    remembered: Array
    frame_sigma: float
    lightness: float
    off: Array
    way: Array
    t_s: Array
    raw: Array
    usable: bool
    push: float


def what_is_shown(dwell: Dwell, plain: PatchCalibration, age_s: float = math.inf) -> Shown:
    """Mean sum and moments of a dwell's images, up to an age of the touch; `plain` with gains of 1 and 0.

    Raises:
        UsageError: its images show no patch.
    """
    image_moments, memory = MomentImage(plain), PadMemory()
    start, end = dwell.t_s[0] + SETTLED_S, dwell.t_s[0] + age_s
    late = []
    sums, moments, ways, at, peaks, kept, bad = [], [], [], [], [], [], 0
    for i, (t, image) in enumerate(zip(dwell.t_s.tolist(), dwell.images, strict=True)):
        patch = compute_patch(image, plain, None if dwell.windows is None else dwell.windows[i])
        if not patch.n_active:
            continue
        way = memory.add(t, patch.u, patch.v)
        found = image_moments.moments(image)
        if t < start or found is None:
            continue
        if t > end and not dwell.to_and_fro:
            late.append(patch.force)
            continue
        bad += patch.saturated or patch.cut_by_pad
        sums.append(patch.force)
        moments.append(found)
        ways.append(way)
        at.append((patch.u, patch.v))
        peaks.append(patch.peak_pa)
        kept.append(i)
    if len(kept) < LEAST_TOUCHES:
        raise UsageError(
            f"a touch of the {dwell.name}: expected a patch in its images, got {len(kept)} images with one"
        )
    c, s = math.cos(dwell.angle), math.sin(dwell.angle)
    turn = np.array([[c * c, 2 * c * s, s * s], [-c * s, c * c - s * s, c * s], [s * s, -2 * c * s, c * c]])
    V, raw, peak = np.array(moments), np.array(at), float(np.mean(peaks))
    steps = np.diff(V[:, [0, 2]], axis=0) / V[:, [0, 2]].mean(axis=0)
    return Shown(
        total=float(np.mean(sums)),
        crept=float(np.mean([*sums, *late]) / np.mean(sums)),
        moments=turn @ V.mean(axis=0),
        remembered=turn @ np.mean(ways, axis=0),
        frame_sigma=float(steps.std() / math.sqrt(2.0)),
        lightness=LEVEL_COUNTS * plain.full_scale_pa / 255 / peak,
        off=raw - dwell.expected[kept],
        way=dwell.expected[kept],
        t_s=dwell.t_s[kept],
        raw=raw,
        usable=bad <= 0.2 * len(kept) and peak < MOST_OF_FULL_SCALE * plain.full_scale_pa,
        push=float(dwell.push[kept].mean()),
    )


# The image model's parameters.


Pairs = Sequence[tuple[Dwell, Shown]]


class Fit(NamedTuple):
    """Parameters, their covariance (5, 5) in the order of `_as_vector`, and the forces (n,) of the touches, N."""

    parameters: ImageParameters
    covariance: Array
    forces: Array


def _as_parameters(z: Array, pitch: float) -> ImageParameters:
    k, scale, blur, crosstalk, memory = z.tolist()
    return ImageParameters(math.exp(k), math.exp(scale), max(blur, 0.1) * pitch, crosstalk, memory)


def _model(parameters: ImageParameters, plain: PatchCalibration, seen: int, errors: MomentErrors) -> ImageModel:
    count = plain.full_scale_pa / 255
    return ImageModel(
        parameters,
        plain.radius_m,
        plain.pitch_m,
        LEVEL_COUNTS * count,
        count,
        side=max(plain.pad.shape),
        seen=seen,
        errors=errors,
    )


_NO_ERRORS = MomentErrors(1.0, 0.0, 1.0, 0.0)


def fit_parameters(  # noqa: PLR0917
    dwells: Sequence[Dwell],
    shown: Sequence[Shown],
    plain: PatchCalibration,
    scale_sigma: float | None,
    reference_sigma: float,
    seen: int,
) -> Fit:
    """Least squares over sums and moments of touches, reference forces and priors.

    Args:
        dwells, shown: the touches.
        plain: full scale, pitch and radius of the probe.
        scale_sigma: of ln(scale) about 0, where the stated full scale is the reference; None: forces are.
        reference_sigma: relative, of reference forces.
        seen: taxels along the side of the window.
    """
    n = len(dwells)
    kappa = np.array([d.kappa for d in dwells])
    S, V, D = (np.array([getattr(s, name) for s in shown]) for name in ("total", "moments", "remembered"))
    known = np.array([i for i, d in enumerate(dwells) if d.force is not None], dtype=int)
    reference = np.array([dwells[i].force for i in known], dtype=float)
    a, b = (0.5 * (1.0 / plain.radius_m + kappa)).T
    prior = np.array([math.log(1e8), 0.0, BLUR_PITCH[0], CROSSTALK[0], MEMORY[0]])
    widths = np.array([5.0, 5.0 if scale_sigma is None else scale_sigma, BLUR_PITCH[1], CROSSTALK[1], MEMORY[1]])

    def residuals(z: Array) -> Array:
        parameters = _as_parameters(z[:5], plain.pitch_m)
        force = np.exp(z[5:])
        depth = np.sqrt(2.0 * force * np.sqrt(a * b) / (math.pi * parameters.stiffness))
        whole = _model(parameters, plain, max(plain.pad.shape), _NO_ERRORS)
        image = whole.shown(depth, a, b)
        part = whole if seen == max(plain.pad.shape) else _model(parameters, plain, seen, _NO_ERRORS)
        M = np.array(part.moments_of(image if part is whole else part.shown(depth, a, b)))
        own = (V - parameters.memory * D)[:, [0, 2]]
        return np.concatenate(
            [
                (own / M - 1.0).reshape(-1) / TOUCH_SIGMA,
                (S / whole.sum_of(image) - 1.0) / TOUCH_SIGMA,
                (z[5:][known] - np.log(reference)) / reference_sigma,
                (z[:5] - prior) / widths,
            ]
        )

    start = np.concatenate([prior, np.log(np.maximum(S, 1e-3))])
    found: Any = least_squares(residuals, start, x_scale=np.array([0.1, 0.1, 0.1, 0.02, 0.03] + n * [0.05]))
    covariance = np.linalg.inv(found.jac.T @ found.jac)[:5, :5]
    return Fit(_as_parameters(found.x[:5], plain.pitch_m), covariance, np.exp(found.x[5:]))


def moment_errors(model: ImageModel, dwells: Sequence[Dwell], shown: Sequence[Shown], forces: Sequence[float]) -> Array:
    """(n, 3) relative errors of V_1, V_2 and of V_12 over their root, at measured forces, N."""
    errors = []
    for dwell, s, force in zip(dwells, shown, forces, strict=True):
        k = (dwell.kappa[0], 0.0, dwell.kappa[1])
        xx, _, yy = model.moments(k, force)
        v = s.moments - model.memory * s.remembered
        errors.append((v[0] / xx - 1.0, v[2] / yy - 1.0, v[1] / math.sqrt(v[0] * v[2])))
    return np.array(errors)


def curvature_errors(
    model: ImageModel, dwells: Sequence[Dwell], shown: Sequence[Shown], forces: Sequence[float]
) -> Array:
    """(n, 2) errors of the principal curvatures from each dwell's moments alone, relative to (κ + 1/R_p)."""
    result = []
    for dwell, s, force in zip(dwells, shown, forces, strict=True):
        v = tuple((s.moments - model.memory * s.remembered).tolist())
        v = (v[0], 0.0, v[2])
        k = model.start(v, force) or (dwell.kappa[0], 0.0, dwell.kappa[1])
        for _ in range(20):
            J, r, _ = model.linearised(v, force, 100.0, k)
            step = np.clip(np.linalg.solve(J[[0, 2]][:, [0, 2]], r[[0, 2]]), -20.0, 20.0)
            least = HOLLOWEST / model.radius
            k = (max(k[0] + float(step[0]), least), 0.0, max(k[2] + float(step[1]), least))
        relative = np.array([1.0 / model.radius + x for x in dwell.kappa])
        result.append((np.array([k[0], k[2]]) - dwell.kappa) / relative)
    return np.array(result)


# Centroids: how they trail, how they scatter, and over which way an error lasts.


def _means(t: Array, at: Array) -> Array:
    """(n, 2) from the slow to the quick exponential mean of places (n, 2), as `PadLag` has them."""
    quick = slow = at[0]
    ways = np.zeros_like(at)
    for i in range(1, len(t)):
        dt = t[i] - t[i - 1]
        quick = quick + (1.0 - math.exp(-dt / TAU_S[0])) * (at[i] - quick)
        slow = slow + (1.0 - math.exp(-dt / TAU_S[1])) * (at[i] - slow)
        ways[i] = quick - slow
    return ways


def fit_centroids(dwells: Sequence[Dwell], shown: Sequence[Shown]) -> tuple[CentroidErrors, Array]:
    """How centroids err, and the (n,) scatter of those of each touch, m.

    Latency and lag from the rolls to and fro, then what is left of all by load, and how long it lasts.

    Hysteresis trails by a way and latency by a time: in the middle of a stroke the ways are alike at any speed. The
    rolls are as short as a scan's: over longer ways the centroid trails further.
    """
    rolls = [s for d, s in zip(dwells, shown, strict=True) if d.to_and_fro]
    latency, latency_sigma = _latency(rolls)

    def left(z: Array, s: Shown, way: Array) -> Array:
        rest: Array = s.off + 1e-4 * z[0] * way / (np.hypot(*way.T)[:, None] + 1e-4 * abs(z[1]))
        return rest

    taught = [(s, _means(s.t_s, s.raw)) for s in rolls or shown]

    def residuals(z: Array) -> Array:
        each = [left(z, *pair) for pair in taught]
        centred = [1e5 * (r - r.mean(axis=0)).reshape(-1) / math.sqrt(len(r)) for r in each]
        return np.concatenate([*centred, [math.log(abs(z[1]) / (1e4 * REACH[0])) / REACH[1]]])

    z = least_squares(residuals, np.array([1.0, 1e4 * REACH[0]])).x
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


def _along(way: Array) -> Array:
    """(n,) path over the pad, m, up to each of its places (n, 2)."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])


def _scatter(r: Array, way: Array) -> float:
    """Standard deviation of errors (n, 2) within `SCATTER_WAY_M`: what lasts longer bends no surface."""
    part = (_along(way) / SCATTER_WAY_M).astype(int)
    variances = [r[part == i].var(axis=0, ddof=1).mean() for i in range(part[-1] + 1) if np.sum(part == i) > 4]
    return math.sqrt(float(np.mean(variances))) if variances else float(r.std())


def _latency(rolls: Sequence[Shown]) -> tuple[float, float]:
    """By which images are older than their stamps, s, and its σ: by the middle of strokes at several speeds."""
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
    return -float(found[1]), math.sqrt(scatter * FRAMES_ALIKE)


def _lasting(errors: Sequence[Array], ways: Sequence[Array]) -> tuple[float, float]:
    """Share of the variance of errors (n, 2) that lasts along the way over the pad, and over which length, m."""
    lags = np.zeros(LAGS)
    for r, way in zip(errors, ways, strict=True):
        s = _along(way)
        grid = np.arange(0.0, s[-1], LAG_STEP_M)
        if len(grid) < 2 * LAGS:
            continue
        on_grid = np.stack([np.interp(grid, s, r[:, i]) for i in (0, 1)])
        on_grid -= on_grid.mean(axis=1, keepdims=True)
        lags += [float((on_grid[:, : len(grid) - k] * on_grid[:, k:]).mean()) for k in range(LAGS)]
    if lags[0] <= 0.0:
        return 0.0, LAG_STEP_M
    # that each error has its mean taken off shifts all of them down
    at = LAG_STEP_M * np.arange(1, LAGS)

    def residuals(z: Array) -> Array:
        rest: Array = z[0] * np.exp(-at / abs(z[1]) / 1e-3) - z[2] - lags[1:] / lags[0]
        return rest

    share, length, shift = least_squares(residuals, np.array([0.5, 1.0, 0.1])).x.tolist()
    return min(max(share / (1.0 + max(shift, 0.0)), 0.0), 1.0), abs(length) * 1e-3


# Taxels.


def taxel_gains(
    pad: Pad, model: ImageModel, dwells: Sequence[Dwell], shown: Sequence[Shown], forces: Sequence[float]
) -> tuple[Array, tuple[tuple[int, int], ...]]:
    """Gain of each taxel over the mean, and those that are dead.

    The image of the model is laid on the centroid of each image; taxels above a fifth of the peak count.

    Returns:
        (rows, columns) gains, 1 where nothing is known; (row, column) of dead taxels.
    """
    from scipy.ndimage import map_coordinates

    seen, wanted, dead = np.zeros((3, *pad.shape))
    u, v = (pad.uv.T / pad.pitch_m).reshape(2, *pad.shape)
    for dwell, s, force in zip(dwells, shown, forces, strict=True):
        a, b = (0.5 * (1.0 / model.radius + x) for x in dwell.kappa)
        quadrant = model.shown(np.array([model.depth(force, a * b)]), np.array([a]), np.array([b]))[0]
        c, si = math.cos(dwell.angle), math.sin(dwell.angle)
        mine = quadrant / model.count
        stamps = dict(zip(s.t_s.tolist(), s.raw / model.pitch, strict=True))
        for t, image in list(zip(dwell.t_s.tolist(), dwell.images, strict=True))[::4]:
            if t not in stamps:
                continue
            x, y = u - stamps[t][0], v - stamps[t][1]
            along, across = np.abs(c * x + si * y), np.abs(-si * x + c * y)
            expected = map_coordinates(mine, [along * STEPS - 0.5, across * STEPS - 0.5], order=1, mode="nearest")
            inside = (expected > 0.25 * mine.max()) & (np.maximum(along, across) < len(mine) / STEPS)
            share = expected[inside].sum() / max(float(image[inside].sum()), 1.0)
            seen[inside] += image[inside] * share
            wanted[inside] += expected[inside]
            dead[inside] += np.where(image[inside] == 0, 1.0, -1.0)
    known = wanted > 10.0 * mine.max()
    gains = np.where(known, seen / np.maximum(wanted, 1.0), 1.0)
    broken = tuple((int(i), int(j)) for i, j in np.argwhere(dead > 0))
    for place in broken:
        gains[place] = 1.0
    return gains, broken


# The layer, by the arm's way into the object.


def stiffness_by_depth(
    dwells: Sequence[Dwell], shown: Sequence[Shown], forces: Sequence[float], radius: float, stiffness: float
) -> tuple[float, float, float, float]:
    """K/h (N/m³) by how far the arm went in between touches of one place; the arm's compliance (m/N); each with its σ.

    On a stiff arm the way between two forces at one place is that of the layer, `δ = √(2 F √det A / (π k))`. What the
    way has more than `stiffness`, which the images show, grows with the force: the arm's compliance.

    Returns:
        NaN where no place was touched with two forces.
    """
    rows = []
    for name, place, turn in sorted({(d.name, d.place, d.turn) for d in dwells}):
        group = [i for i, d in enumerate(dwells) if (d.name, d.place, d.turn) == (name, place, turn)]
        if len(group) < 2:
            continue
        unit = np.array([indentation_from_force(forces[i], 1.0, radius, dwells[i].kappa) for i in group])
        push, force = np.array([shown[i].push for i in group]), np.array([forces[i] for i in group])
        rows += list(zip(unit - unit.mean(), force - force.mean(), push - push.mean(), strict=True))
    if not rows:
        return (math.nan,) * 4
    unit, force, push = np.array(rows).T
    root = float(unit @ push / (unit @ unit))
    sigma = math.sqrt(float(np.mean((push - root * unit) ** 2)) / float(unit @ unit))
    more = push - unit / math.sqrt(stiffness)
    compliance = float(force @ more / (force @ force))
    scatter = math.sqrt(float(np.mean((more - compliance * force) ** 2)) / float(force @ force))
    if root <= 0.0:
        return math.nan, math.nan, compliance, scatter
    return root**-2, 2.0 * sigma / root**3, compliance, scatter


# All of it.


@dataclass(frozen=True, slots=True, eq=False)
class ArrayFit:
    """A calibration, and what people want to see of it.

    Attributes:
        calibration: the result.
        dwells, shown, forces: the touches that were used, and their forces by it, N.
        errors: (n, 3) relative errors of moments of each touch by a fit that has not seen it.
        curvature_errors: (n, 2) the same of the curvatures, relative to (κ + 1/R_p).
        scatter: (n,) of the centroids of each touch, m.
        left_out: touches that saturated or ran off the pad.
        gains: (16, 16) of the taxels; with them moments err by `gained`, without by `plain` (RMS, relative).
        offset, object_offset: (2,) of centroids that turns with the probe, and that stays with the object, m; NaN
            without turned touches.
    """

    calibration: ArrayCalibration
    dwells: Sequence[Dwell]
    shown: Sequence[Shown]
    forces: Array
    errors: Array
    curvature_errors: Array
    scatter: Array
    left_out: int
    gains: Array
    gained: float
    plain: float
    offset: Array
    object_offset: Array


def calibrate_array(
    dwells: Sequence[Dwell],
    *,
    pad: Pad,
    reference: ForceReference,
    reference_sigma: float,
    array: str,
    date: str,
    made_on: str,
    own_gains: bool = True,
) -> ArrayFit:
    """Everything that touches of known things say about an array.

    Args:
        dwells: touches of plane and ball, at more than one force and place; those of a rod only verify.
        pad: its taxels, and the stated pressure of a full count.
        reference: what newtons rest on. "scale" and "weights" need touches with a force; "unit" trusts the full scale.
        reference_sigma: its relative standard deviation.
        array, date, made_on: for the file.
        own_gains: use taxel gains where they help: the file is of this array, not of its make.

    Raises:
        UsageError: too few touches, or no force where the reference is one.
    """
    by_force = reference in ("scale", "weights")
    dwells = dwells if by_force else [replace(d, force=None) for d in dwells]
    plain = PatchCalibration(pad)
    every = [(d, what_is_shown(d, plain, AGE_S)) for d in dwells]
    used = {id(d) for d, s in every if s.usable}
    count = sum(s.usable and d.name != "rod" for d, s in every)
    if count < LEAST_TOUCHES or len({d.name for d, s in every if s.usable and d.name != "rod"}) < 2:
        raise UsageError(
            f"expected at least {LEAST_TOUCHES} touches of a plane and a ball that neither saturate nor leave the pad,"
            f" got {count}"
        )
    if by_force and not any(d.force is not None and id(d) in used for d in dwells):
        raise UsageError(f'force reference "{reference}": expected touches with a known force, got none')
    scale_sigma = None if by_force else max(reference_sigma, 1e-4) if reference == "unit" else 1e-4
    seen = max(pad.shape) if dwells[0].windows is None else max(w[2] for w in dwells[0].windows)
    blank = _blank(array, date, made_on, reference, reference_sigma, pad.full_scale_pa)

    def fit(pairs: Pairs, own: PatchCalibration) -> tuple[ArrayCalibration, Fit]:
        sigma = reference_sigma if by_force else 1.0
        found = fit_parameters([d for d, _ in pairs], [s for _, s in pairs], own, scale_sigma, sigma, seen)
        crept = [s.crept for d, s in pairs if d.force is not None]
        scale = found.parameters.scale * (float(np.mean(crept)) if crept else 1.0)
        return replace(blank, image=replace(found.parameters, scale=scale), gains=own.gains), found

    good = [(d, s) for d, s in every if s.usable]
    fitted = [(d, s) for d, s in good if d.name != "rod"]
    first, found = fit(fitted, plain)
    gained, alike = _by_gains(fitted, first, plain, seen)
    gains, dead = _gains(fitted, first, plain)
    own = plain
    if own_gains and gained < HELPFUL * alike:
        own = replace(plain, gains=tuple(tuple(row) for row in np.round(gains, 4).tolist()))
        good = [(d, what_is_shown(d, own, AGE_S)) for d, _ in good]
        fitted = [(d, s) for d, s in good if d.name != "rod"]
        first, found = fit(fitted, own)
    errors, curvatures, force_errors = _held_out(fitted, lambda pairs: fit(pairs, own)[0], own, seen)
    ds, ss = [d for d, _ in fitted], [s for _, s in fitted]
    k, k_sigma, compliance, _ = stiffness_by_depth(
        ds, ss, found.forces.tolist(), pad.radius_m, found.parameters.stiffness
    )
    rods = [(d, s) for d, s in good if d.name == "rod"]
    across = _rms(_checked(first, rods, own, seen)[1][:, 0]) if rods else math.nan
    relative = math.sqrt(float(found.covariance[0, 0]))
    centroid, scatter = fit_centroids(ds, ss)
    calibration = replace(
        first,
        moments=_moment_errors(errors, ss),
        centroid=centroid,
        stiffness=StiffnessSources(
            found.parameters.stiffness, found.parameters.stiffness * relative, k, k_sigma, compliance
        ),
        residuals=Residuals(len(fitted), _rms(force_errors), _rms(errors[:, :2]), _rms(curvatures), across),
        dead=dead if own_gains else (),
    )
    offset, of_object = _offsets(good)
    patch = make_patch_calibration(calibration, pad)
    forces = np.array([_force(patch, s) for s in ss])
    return ArrayFit(
        calibration=calibration,
        dwells=ds,
        shown=ss,
        forces=forces,
        errors=errors,
        curvature_errors=curvatures,
        scatter=scatter,
        left_out=len(every) - len(good),
        gains=gains,
        gained=gained,
        plain=alike,
        offset=offset,
        object_offset=of_object,
    )


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(np.square(values)))) if len(values) else math.nan


def _blank(  # noqa: PLR0917
    array: str, date: str, made_on: str, reference: ForceReference, sigma: float, full_scale: float
) -> ArrayCalibration:
    nan = math.nan
    return ArrayCalibration(
        array,
        date,
        made_on,
        reference,
        nan if reference == "none" else sigma,
        full_scale,
        ImageParameters(1.0, 1.0, 1.0, 0.0, 0.0),
        _NO_ERRORS,
        CentroidErrors(nan, nan, nan, nan, nan, nan, Lag(0.0, 1.0)),
        StiffnessSources(nan, nan, nan, nan, nan),
        Residuals(0, nan, nan, nan, nan),
    )


def _force(patch: PatchCalibration, s: Shown) -> float:
    return patch.force_gain * s.total + patch.edge_gain * math.sqrt(s.total)


def _checked(
    calibration: ArrayCalibration, pairs: Pairs, plain: PatchCalibration, seen: int
) -> tuple[Array, Array, Array]:
    """Errors (n, 3) of moments, (n, 2) of curvatures and (m,) of reference forces of touches by a calibration."""
    patch = make_patch_calibration(calibration, plain.pad)
    model = make_image_model(calibration, patch, seen=seen)
    measured = [_force(patch, s) for _, s in pairs]
    parts = [d for d, _ in pairs], [s for _, s in pairs], measured
    forces = [f / d.force - 1.0 for f, (d, _) in zip(measured, pairs, strict=True) if d.force is not None]
    return moment_errors(model, *parts), curvature_errors(model, *parts), np.array(forces)


def _held_out(
    pairs: Pairs, fit: Callable[[Pairs], ArrayCalibration], plain: PatchCalibration, seen: int
) -> tuple[Array, Array, Array]:
    """As `_checked`, each fifth of the touches by a calibration that was fitted to the others."""
    errors, curvatures, forces = np.zeros((len(pairs), 3)), np.zeros((len(pairs), 2)), []
    for fold in range(FOLDS):
        out = list(range(fold, len(pairs), FOLDS))
        found = _checked(fit([p for i, p in enumerate(pairs) if i not in out]), [pairs[i] for i in out], plain, seen)
        errors[out], curvatures[out] = found[:2]
        forces.append(found[2])
    return errors, curvatures, np.concatenate(forces)


def _moment_errors(errors: Array, shown: Sequence[Shown]) -> MomentErrors:
    """What is left of touches that the fit had not seen, and of shapes that nobody touched."""
    scaled = errors * np.sqrt(USUAL_LIGHTNESS / np.array([s.lightness for s in shown]))[:, None]
    moment = float(np.mean(scaled[:, :2] ** 2)) + FORM_SIGMA**2
    return MomentErrors(
        moment=moment,
        both=float(np.clip(np.mean(scaled[:, 0] * scaled[:, 1]), 0.0, 0.5 * moment)),
        shear=float(np.mean(scaled[:, 2] ** 2)) + 0.25 * FORM_SIGMA**2,
        frame_sigma=float(np.median([s.frame_sigma for s in shown])),
    )


def _gains(
    pairs: Pairs, calibration: ArrayCalibration, plain: PatchCalibration
) -> tuple[Array, tuple[tuple[int, int], ...]]:
    """(16, 16) gains of the taxels by these touches, and dead ones."""
    patch = make_patch_calibration(calibration, plain.pad)
    model = make_image_model(calibration, patch, seen=None)
    return taxel_gains(
        plain.pad, model, [d for d, _ in pairs], [s for _, s in pairs], [_force(patch, s) for _, s in pairs]
    )


def _by_gains(pairs: Pairs, calibration: ArrayCalibration, plain: PatchCalibration, seen: int) -> tuple[float, float]:
    """RMS error of the moments of each half of the touches, with gains of the taxels from the other, and without."""
    gained, alike = [], []
    for half in (0, 1):
        gains = _gains(pairs[half::2], calibration, plain)[0]
        own = replace(plain, gains=tuple(tuple(row) for row in gains.tolist()))
        check = [(d, what_is_shown(d, own, AGE_S)) for d, _ in pairs[1 - half :: 2]]
        gained.append(_checked(calibration, check, plain, seen)[0][:, :2])
        alike.append(_checked(calibration, pairs[1 - half :: 2], plain, seen)[0][:, :2])
    return _rms(np.concatenate(gained)), _rms(np.concatenate(alike))


def _offsets(pairs: Pairs) -> tuple[Array, Array]:
    """(2,) offset of centroids that turns with the probe, and (2,) that stays with the object, m.

    A gradient of the taxels' gains and an error of the tool turn with the probe; an object that does not stand where it
    should be does not.
    """
    unknown = np.full(2, math.nan)
    mine, its = [], []
    for name in sorted({d.name for d, _ in pairs if abs(d.turn) > 0.5 and d.name != "rod"}):
        straight = [s.off.mean(axis=0) for d, s in pairs if d.name == name and d.turn == 0.0]
        turned = [s.off.mean(axis=0) for d, s in pairs if d.name == name and abs(d.turn) > 0.5]
        if straight:
            mine.append(0.5 * (np.mean(straight, axis=0) + np.mean(turned, axis=0)))
            its.append(0.5 * (np.mean(straight, axis=0) - np.mean(turned, axis=0)))
    return (np.mean(mine, axis=0), np.mean(its, axis=0)) if mine else (unknown, unknown)
