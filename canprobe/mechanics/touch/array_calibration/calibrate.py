"""Calibrate an array by touches of a plane and a ball that were rolled to and fro; a rod verifies.

`parameter_fit` finds the parameters of the image model, `pad_fit` the errors of centroids, `taxel_gains` the gains of
taxels, and `push_fit` the stiffness by the arm's way into the object. Errors are held out: each fifth of the touches
is predicted by a fit to the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from canprobe.errors import UsageError
from canprobe.mechanics.touch.array_calibration.pad_fit import fit_noise
from canprobe.mechanics.touch.array_calibration.parameter_fit import (
    ParameterFit,
    curvature_errors,
    fit_parameters,
    moment_errors,
    taxel_gains,
)
from canprobe.mechanics.touch.array_calibration.push_fit import fit_force, stiffness_by_depth
from canprobe.mechanics.touch.array_calibration.touches import (
    LAST_IMAGE_S,
    Dwell,
    Shown,
    what_is_shown,
)
from canprobe.mechanics.touch.contact import indentation_from_force
from canprobe.mechanics.touch.image.calibration import (
    NO_ERRORS,
    ArrayCalibration,
    ForceReference,
    ImageParameters,
    MomentErrors,
    Residuals,
    StiffnessSources,
)
from canprobe.mechanics.touch.image.force_errors import MAKE_SPREAD, USUAL_LIGHTNESS
from canprobe.mechanics.touch.image.image_model import MOMENT_ERROR_POWER, ImageModel, with_force_gains
from canprobe.mechanics.touch.image.patch import PatchCalibration
from canprobe.mechanics.touch.linear_algebra import rms
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.types import Floats

FORM_SIGMA = 0.01
"""Relative error of a moment on cylinders and saddles by the form of the model, which planes and balls do not show."""
FOLDS = 5
"""Number of parts of the touches, each of which is held out once."""
MIN_TOUCHES = 10
"""Least number of touches of plane and ball."""
MAX_ERROR_LEFT_SHARE = 0.9
"""Largest error of moments with gains of the taxels, over the error without, at which the gains are used."""


@dataclass(frozen=True, slots=True, eq=False)
class ArrayFit:
    """A calibration, with the data for its report.

    Attributes:
        calibration: the result.
        touches: the touches that were used.
        forces: (n,) their forces by the calibration, N.
        errors: (n, 3) relative errors of moments of each touch by a fit that has not seen it.
        curvature_errors: (n, 2) errors of curvatures by that fit, relative to (κ + 1/R_p).
        scatter: (n,) scatter of the centroids of each touch, m.
        left_out: number of touches that saturated or ran off the pad.
        gains: (16, 16) gains of the taxels.
        gained, plain: relative RMS error of moments with these gains, and without.
        offset, object_offset: (2,) offset of centroids that turns with the probe, and offset that stays with the
            object, m; NaN without turned touches.
    """

    calibration: ArrayCalibration
    touches: Sequence[Shown]
    forces: Floats
    errors: Floats
    curvature_errors: Floats
    scatter: Floats
    left_out: int
    gains: Floats
    gained: float
    plain: float
    offset: Floats
    object_offset: Floats


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
    spread: float = MAKE_SPREAD,
) -> ArrayFit:
    """Calibrate an array by touches of known objects.

    Args:
        dwells: touches of plane and ball, at more than one force and place; those of a rod only verify.
        pad: taxels of the array, and the stated pressure of a full count.
        reference: reference of newtons. "scale" and "weights" need touches with a force; "unit" relies on the stated
            full scale.
        reference_sigma: relative standard deviation of the reference.
        array, date, made_on: entries of the file.
        own_gains: whether taxel gains are used where they help; False where the file is for all arrays of a make.
        spread: relative standard deviation of the force between the arrays of a make; not that of one array.

    Raises:
        UsageError: there are too few touches, or none has a force where the reference is one.
    """
    by_force = reference in ("scale", "weights")
    dwells = dwells if by_force else [replace(d, force=None) for d in dwells]
    plain = PatchCalibration(pad)
    every = [what_is_shown(d, plain, LAST_IMAGE_S) for d in dwells]
    good = [s for s in every if s.usable]
    fitted = _without_rods(good)
    if len(fitted) < MIN_TOUCHES or len({s.dwell.name for s in fitted}) < 2:
        raise UsageError(
            f"expected at least {MIN_TOUCHES} touches of a plane and a ball that neither saturate nor leave the pad,"
            f" got {len(fitted)}"
        )
    if by_force and not any(s.dwell.force is not None for s in good):
        raise UsageError(f'force reference "{reference}": expected touches with a known force, got none')
    # without a reference newtons are nominal, and the scale is 1 by definition; 1e-4 and not 0: residuals are over it
    scale_sigma = None if by_force else max(reference_sigma, 1e-4) if reference == "unit" else 1e-4
    seen = side_seen(dwells)

    def fit(touches: Sequence[Shown], own: PatchCalibration) -> ParameterFit:
        found = fit_parameters(touches, own, scale_sigma, reference_sigma if by_force else 1.0, seen)
        crept = [s.crept for s in touches if s.dwell.force is not None]
        scale = found.parameters.scale * (float(np.mean(crept)) if crept else 1.0)
        return found._replace(parameters=replace(found.parameters, scale=scale))

    found, own = fit(fitted, plain), plain
    gained, alike = _by_gains(fitted, found.parameters, plain, seen)
    gains, dead = _gains(fitted, found.parameters, plain)
    if own_gains and gained < MAX_ERROR_LEFT_SHARE * alike:
        # rounded before the fit: the file has these gains, and the parameters are those for them
        own = replace(plain, gains=tuple(tuple(row) for row in np.round(gains, 4).tolist()))
        good = [what_is_shown(s.dwell, own, LAST_IMAGE_S) for s in good]
        fitted = _without_rods(good)
        found = fit(fitted, own)
    errors, curvatures, force_errors = _held_out(fitted, lambda touches: fit(touches, own).parameters, own, seen)
    stiffness = found.parameters.stiffness
    by_images = stiffness, stiffness * math.sqrt(float(found.covariance[0, 0]))
    by_depth = stiffness_by_depth(fitted, found.forces.tolist(), pad.radius_m, by_images)
    rods = [s for s in good if s.dwell.name == "rod"]
    across = rms(_checked(found.parameters, rods, own, seen)[1][:, 0]) if rods else math.nan
    patch = with_force_gains(own, found.parameters)
    noise, centroid, scatter = fit_noise(fitted, [_depths(s, patch, stiffness) for s in fitted])
    calibration = ArrayCalibration(
        array=array,
        date=date,
        made_on=made_on,
        force_reference=reference,
        force_sigma=math.nan if reference == "none" else reference_sigma,
        full_scale=pad.full_scale_pa,
        image=found.parameters,
        moments=_moment_errors(errors, fitted),
        noise=noise,
        centroid=centroid,
        stiffness=StiffnessSources(*by_images, *by_depth),
        residuals=Residuals(len(fitted), rms(force_errors), rms(errors[:, :2]), rms(curvatures), across),
        force=fit_force(fitted, patch, stiffness, force_errors, 0.0 if own_gains else spread),
        gains=own.gains,
        dead=dead if own_gains else (),
    )
    offset, of_object = _offsets(good)
    return ArrayFit(
        calibration=calibration,
        touches=fitted,
        forces=np.array([force_of(patch, s) for s in fitted]),
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


def _without_rods(touches: Sequence[Shown]) -> list[Shown]:
    """The touches that are fitted; those of a rod verify."""
    return [s for s in touches if s.dwell.name != "rod"]


def side_seen(dwells: Sequence[Dwell]) -> int:
    """Taxels along the longer side of what images show."""
    return max(window[2] for window in dwells[0].windows)


def at_usual_lightness(errors: Floats, shown: Sequence[Shown]) -> Floats:
    """Errors (n, k) of the moments of n touches, as those of touches of `USUAL_LIGHTNESS`: light ones err more."""
    light = np.array([[s.lightness] for s in shown])
    return errors * (USUAL_LIGHTNESS / light) ** (0.5 * MOMENT_ERROR_POWER)


def force_of(patch: PatchCalibration, s: Shown) -> float:
    """Mean force of a touch by the gains of a calibration, N, with its creep."""
    return patch.force_gain * s.total + patch.edge_gain * math.sqrt(s.total)


def _depths(s: Shown, patch: PatchCalibration, stiffness: float) -> Floats:
    """(n,) depth of the layer in each image of a touch, m."""
    at_1_n = indentation_from_force(1.0, stiffness, patch.pad.radius_m, s.dwell.kappa)
    return at_1_n * np.sqrt(patch.force_gain * s.sums + patch.edge_gain * np.sqrt(s.sums))


def _checked(
    parameters: ImageParameters, touches: Sequence[Shown], plain: PatchCalibration, seen: int
) -> tuple[Floats, Floats, Floats]:
    """Errors (n, 3) of moments, (n, 2) of curvatures and (m,) of reference forces of touches by a model."""
    patch, model = with_force_gains(plain, parameters), ImageModel(parameters, NO_ERRORS, plain.pad, seen)
    measured = [force_of(patch, s) for s in touches]
    # a reference load is read over the whole touch, and creep is part of it
    known = [(f, s.crept, s.dwell.force) for f, s in zip(measured, touches, strict=True) if s.dwell.force is not None]
    forces = np.array([f * crept / force - 1.0 for f, crept, force in known])
    return moment_errors(model, touches, measured), curvature_errors(model, touches, measured), forces


def _held_out(
    touches: Sequence[Shown], fit: Callable[[Sequence[Shown]], ImageParameters], plain: PatchCalibration, seen: int
) -> tuple[Floats, Floats, Floats]:
    """As `_checked`, each fifth of the touches by parameters that were fitted to the others."""
    errors, curvatures, forces = np.zeros((len(touches), 3)), np.zeros((len(touches), 2)), []
    for fold in range(FOLDS):
        out = list(range(fold, len(touches), FOLDS))
        found = fit([s for i, s in enumerate(touches) if i not in out])
        errors[out], curvatures[out], of_forces = _checked(found, [touches[i] for i in out], plain, seen)
        forces.append(of_forces)
    return errors, curvatures, np.concatenate(forces)


def _moment_errors(errors: Floats, shown: Sequence[Shown]) -> MomentErrors:
    """Errors of moments from touches that the fit has not seen, with `FORM_SIGMA` for shapes that were not touched."""
    scaled = at_usual_lightness(errors, shown)
    moment = float(np.mean(scaled[:, :2] ** 2)) + FORM_SIGMA**2
    return MomentErrors(
        moment=moment,
        both=float(np.clip(np.mean(scaled[:, 0] * scaled[:, 1]), 0.0, 0.5 * moment)),
        shear=float(np.mean(scaled[:, 2] ** 2)) + 0.25 * FORM_SIGMA**2,
        frame_sigma=float(np.median([s.frame_sigma for s in shown])),
    )


def _gains(
    touches: Sequence[Shown], parameters: ImageParameters, plain: PatchCalibration
) -> tuple[Floats, tuple[tuple[int, int], ...]]:
    """(16, 16) gains of the taxels by these touches, and dead ones."""
    patch, model = with_force_gains(plain, parameters), ImageModel(parameters, NO_ERRORS, plain.pad)
    return taxel_gains(plain.pad, model, touches, [force_of(patch, s) for s in touches])


def _by_gains(
    touches: Sequence[Shown], parameters: ImageParameters, plain: PatchCalibration, seen: int
) -> tuple[float, float]:
    """RMS error of the moments of each half of the touches, with gains of the taxels from the other, and without."""
    gained, alike = [], []
    for half in (0, 1):
        gains, other = _gains(touches[half::2], parameters, plain)[0], touches[1 - half :: 2]
        own = replace(plain, gains=tuple(tuple(row) for row in gains.tolist()))
        check = [what_is_shown(s.dwell, own, LAST_IMAGE_S) for s in other]
        gained.append(_checked(parameters, check, plain, seen)[0][:, :2])
        alike.append(_checked(parameters, other, plain, seen)[0][:, :2])
    return rms(np.concatenate(gained)), rms(np.concatenate(alike))


def _offsets(touches: Sequence[Shown]) -> tuple[Floats, Floats]:
    """(2,) offset of centroids that turns with the probe, and (2,) that stays with the object, m."""
    # a gradient of the taxels' gains and an error of the tool turn with the probe; a wrong place of the object does not
    unknown = np.full(2, math.nan)
    mine, its = [], []
    for name in sorted({s.dwell.name for s in _without_rods(touches) if abs(s.dwell.turn) > 0.5}):
        same = [s for s in touches if s.dwell.name == name]
        straight = [s.off.mean(axis=0) for s in same if s.dwell.turn == 0.0]
        turned = [s.off.mean(axis=0) for s in same if abs(s.dwell.turn) > 0.5]
        if straight:
            mine.append(0.5 * (np.mean(straight, axis=0) + np.mean(turned, axis=0)))
            its.append(0.5 * (np.mean(straight, axis=0) - np.mean(turned, axis=0)))
    return (np.mean(mine, axis=0), np.mean(its, axis=0)) if mine else (unknown, unknown)
