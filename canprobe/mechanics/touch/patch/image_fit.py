"""Touches of known objects, what their images show, and the image model's parameters that fit to them.

What is known of a touch is the curvature of the object and where on the pad it should lie. Its force is an unknown of
its own, but for a few whose force something else measured: the reference. Without any the scale of the force is a
guess, and stiffness goes with it.

Three of the parameters are hardly told apart by planes and balls alone: blur, crosstalk and memory carry a weak prior
of what arrays of films and foams are like.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from canprobe.errors import UsageError
from canprobe.mechanics.touch.linear_algebra import Array
from canprobe.mechanics.touch.patch.array_calibration import ImageParameters, MomentErrors
from canprobe.mechanics.touch.patch.image import Image, PatchCalibration, compute_patch
from canprobe.mechanics.touch.patch.image_model import ImageModel
from canprobe.mechanics.touch.patch.moments import LEVEL_COUNTS, MomentImage, PadMemory

BLUR_PITCH = (0.7, 0.2)
CROSSTALK = (0.025, 0.01)
MEMORY = (0.03, 0.02)
"""Mean and standard deviation of what is expected of any array."""
TOUCH_SIGMA = 0.012
"""Relative error of moments and sums of a touch: gains, hysteresis and creep."""
SETTLED_S, AGE_S = 0.5, 3.5
"""From the touch to the first image that counts, and to the last: all touches are compared after as much creep."""
MOST_OF_FULL_SCALE = 0.7
"""Peak over full scale above which a touch is left out: taxels bend off before they saturate."""
HOLLOWEST = -0.9
"""Least curvature that is looked for, over that of the probe."""

LEAST_IMAGES = 10
NO_ERRORS = MomentErrors(1.0, 0.0, 1.0, 0.0)
"""Of a model that is only asked forward."""


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
    if len(kept) < LEAST_IMAGES:
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
    side = max(plain.pad.shape)
    prior = np.array([math.log(1e8), 0.0, BLUR_PITCH[0], CROSSTALK[0], MEMORY[0]])
    widths = np.array([5.0, 5.0 if scale_sigma is None else scale_sigma, BLUR_PITCH[1], CROSSTALK[1], MEMORY[1]])

    def residuals(z: Array) -> Array:
        parameters = _as_parameters(z[:5], plain.pitch_m)
        force = np.exp(z[5:])
        depth = np.sqrt(2.0 * force * np.sqrt(a * b) / (math.pi * parameters.stiffness))
        whole = _model(parameters, plain, side, NO_ERRORS)
        image = whole.shown(depth, a, b)
        part = whole if seen == side else _model(parameters, plain, seen, NO_ERRORS)
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
