"""Fits the image model to images of touches: its parameters, the errors that are left, and the gains of taxels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from canprobe.mechanics.touch.array_calibration.touches import (
    BLUR_PRIOR_PITCH,
    CROSSTALK_PRIOR,
    MEMORY_PRIOR,
    MIN_CURVATURE_SHARE,
    TOUCH_SIGMA,
    Shown,
)
from canprobe.mechanics.touch.image.calibration import NO_ERRORS, ImageParameters
from canprobe.mechanics.touch.image.image_model import STEPS_PER_PITCH, ImageModel
from canprobe.mechanics.touch.image.patch import PatchCalibration
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.types import Floats


class ParameterFit(NamedTuple):
    """Parameters, their covariance (5, 5) in the order of `ImageParameters`, and the forces (n,) of the touches, N."""

    parameters: ImageParameters
    covariance: Floats
    forces: Floats


def _as_parameters(z: Floats, pitch: float) -> ImageParameters:
    k, scale, blur, crosstalk, memory = z.tolist()
    return ImageParameters(math.exp(k), math.exp(scale), max(blur, 0.1) * pitch, crosstalk, memory)


def fit_parameters(
    touches: Sequence[Shown], plain: PatchCalibration, scale_sigma: float | None, reference_sigma: float, seen: int
) -> ParameterFit:
    """Least squares over sums and moments of touches, reference forces and priors.

    Args:
        touches: the touches.
        plain: full scale, pitch and radius of the probe.
        scale_sigma: standard deviation of ln(scale) about 0, where the stated full scale is the reference; None where
            forces are.
        reference_sigma: relative standard deviation of reference forces.
        seen: number of taxels along the side of the window.
    """
    kappa = np.array([s.dwell.kappa for s in touches])
    S, V, D = (np.array([getattr(s, name) for s in touches]) for name in ("total", "moments", "remembered"))
    known = np.array([i for i, s in enumerate(touches) if s.dwell.force is not None], dtype=int)
    reference = np.array([touches[i].dwell.force for i in known], dtype=float)
    a, b = (0.5 * (1.0 / plain.pad.radius_m + kappa)).T
    side = max(plain.pad.shape)
    prior = np.array([math.log(1e8), 0.0, BLUR_PRIOR_PITCH[0], CROSSTALK_PRIOR[0], MEMORY_PRIOR[0]])
    widths = np.array(
        [5.0, 5.0 if scale_sigma is None else scale_sigma, BLUR_PRIOR_PITCH[1], CROSSTALK_PRIOR[1], MEMORY_PRIOR[1]]
    )

    def residuals(z: Floats) -> Floats:
        parameters = _as_parameters(z[:5], plain.pad.pitch_m)
        force = np.exp(z[5:])
        depth = np.sqrt(2.0 * force * np.sqrt(a * b) / (math.pi * parameters.stiffness))
        whole = ImageModel(parameters, NO_ERRORS, plain.pad)
        image = whole.shown(depth, a, b)
        part = whole if seen == side else ImageModel(parameters, NO_ERRORS, plain.pad, seen)
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
    found: Any = least_squares(residuals, start, x_scale=np.array([0.1, 0.1, 0.1, 0.02, 0.03] + len(touches) * [0.05]))
    covariance = np.linalg.inv(found.jac.T @ found.jac)[:5, :5]
    return ParameterFit(_as_parameters(found.x[:5], plain.pad.pitch_m), covariance, np.exp(found.x[5:]))


def moment_errors(model: ImageModel, touches: Sequence[Shown], forces: Sequence[float]) -> Floats:
    """(n, 3) relative errors of V_1, V_2 and of V_12 over their root, at measured forces, N."""
    errors = []
    for s, force in zip(touches, forces, strict=True):
        k = (s.dwell.kappa[0], 0.0, s.dwell.kappa[1])
        xx, _, yy = model.moments(k, force)
        v = s.moments - model.parameters.memory * s.remembered
        errors.append((v[0] / xx - 1.0, v[2] / yy - 1.0, v[1] / math.sqrt(v[0] * v[2])))
    return np.array(errors)


def curvature_errors(model: ImageModel, touches: Sequence[Shown], forces: Sequence[float]) -> Floats:
    """(n, 2) errors of the principal curvatures from each touch's moments alone, relative to (κ + 1/R_p)."""
    result = []
    for s, force in zip(touches, forces, strict=True):
        v = tuple((s.moments - model.parameters.memory * s.remembered).tolist())
        v = (v[0], 0.0, v[2])
        kappa = s.dwell.kappa
        shows = (kappa[0], 0.0, kappa[1])
        k = model.start(v, force) or shows
        for _ in range(20):
            try:
                J, r, _ = model.linearised(v, force, 100.0, k)  # frames weigh only
            except ValueError:  # nothing would be above the level: half the way back to where something is
                k = (0.5 * (k[0] + shows[0]), 0.0, 0.5 * (k[2] + shows[2]))
                continue
            shows = k
            step = np.clip(np.linalg.solve(J[[0, 2]][:, [0, 2]], r[[0, 2]]), -20.0, 20.0)
            least = MIN_CURVATURE_SHARE / model.radius
            k = (max(k[0] + float(step[0]), least), 0.0, max(k[2] + float(step[1]), least))
        relative = np.array([1.0 / model.radius + x for x in kappa])
        result.append((np.array([k[0], k[2]]) - kappa) / relative)
    return np.array(result)


def taxel_gains(
    pad: Pad, model: ImageModel, touches: Sequence[Shown], forces: Sequence[float]
) -> tuple[Floats, tuple[tuple[int, int], ...]]:
    """Gain of each taxel over the mean, and dead taxels.

    The model's image is placed on the centroid of each image; taxels above a quarter of its peak are used.

    Args:
        pad: the taxels.
        model: the image model.
        touches: the touches.
        forces: their forces, N.

    Returns:
        (rows, columns) gains, 1 where nothing is known; (row, column) of dead taxels.
    """
    from scipy.ndimage import map_coordinates  # late: only a calibration needs it, and it takes long to load

    seen, wanted, dead = np.zeros((3, *pad.shape))
    u, v = (pad.uv.T / pad.pitch_m).reshape(2, *pad.shape)
    for s, force in zip(touches, forces, strict=True):
        dwell = s.dwell
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
            expected = map_coordinates(
                mine, [along * STEPS_PER_PITCH - 0.5, across * STEPS_PER_PITCH - 0.5], order=1, mode="nearest"
            )
            inside = (expected > 0.25 * mine.max()) & (np.maximum(along, across) < len(mine) / STEPS_PER_PITCH)
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
