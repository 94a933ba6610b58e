"""Fits what the arm's way into the object shows: the stiffness of the layer, creep, and the scatter of the force.

The way is a second measure of the force, `F = π k δ² / (2 √det A)`, which does not creep. Between two forces at one
place it is that of the layer; beyond that it grows by the compliance of the arm. In a long touch the pressure sum over
that force grows by the creep alone, whether the force or the way is held. Between touches it scatters by what the array
and the way err together.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from canprobe.mechanics.touch.array_calibration.touches import FIRST_IMAGE_S, LAST_IMAGE_S, Dwell, Shown
from canprobe.mechanics.touch.contact import indentation_from_force
from canprobe.mechanics.touch.image.force_creep import ForceCreep
from canprobe.mechanics.touch.image.force_errors import USUAL_LIGHTNESS, ForceErrors
from canprobe.mechanics.touch.image.patch import PatchCalibration, compute_patch
from canprobe.mechanics.touch.linear_algebra import rms
from canprobe.mechanics.types import Floats

CREEP_PRIOR = (0.05, 0.03)
"""Mean and standard deviation of the growth per decade, from data sheets of resistive arrays."""
MIN_CREEP_SIGMA = 0.006
"""Least standard deviation of the growth per decade: over emulated arrays the fit errs by as much."""
LONG_TOUCH_S, FIRST_CREEP_S = 7.0, 1.5
"""Least length of a touch that shows creep, s, and the time in which hysteresis settles in it."""
MIN_ARRAY_SIGMA = 0.009
"""Least standard deviation of the force: touches at one place do not show how gains differ from place to place."""
CREEP_ROUNDS = 3
"""Number of rounds of the fit of the growth, which bends the load that it follows."""


def fit_force(
    touches: Sequence[Shown], patch: PatchCalibration, stiffness: float, held_out: Floats, spread: float
) -> ForceErrors:
    """Errors of the force of an array.

    Args:
        touches: touches of plane and ball.
        patch: from counts to force, with the force gains of the calibration.
        stiffness: stiffness K/h of the layer, N/m³.
        held_out: (m,) relative errors of the reference loads by fits that have not seen them; empty without any.
        spread: standard deviation from array to array, relative.
    """
    dwells = [s.dwell for s in touches]
    forces = [_forces(d, patch) for d in dwells]
    units = [indentation_from_force(1.0, stiffness, patch.pad.radius_m, d.kappa) for d in dwells]
    creep, sigma = _creep(dwells, forces, units)
    loads = [i for i, d in enumerate(dwells) if d.force is not None]
    pairs = zip(dwells, forces, strict=True)
    corrected, decades = np.array([_corrected(d, f, creep, full=d.force is not None) for d, f in pairs]).T
    more = np.sqrt(np.maximum(np.array([s.lightness for s in touches]) / USUAL_LIGHTNESS, 1.0))
    scatter = _scatter(touches, corrected, np.array(units)) / more
    array = rms(scatter)
    if len(held_out):
        array = math.hypot(array, rms(held_out) / rms(more[loads]))
    used = loads or list(range(len(dwells)))
    return ForceErrors(
        creep=creep,
        creep_sigma=sigma,
        creep_decades=float(decades[used].mean()),
        array=max(array, MIN_ARRAY_SIGMA),
        spread=spread,
        highest=float(corrected.max()),
    )


def _forces(dwell: Dwell, patch: PatchCalibration) -> Floats:
    """(n,) force of each image, N, with its creep."""
    return np.array([compute_patch(i, patch, w).force for i, w in zip(dwell.images, dwell.windows, strict=True)])


def _followed(dwell: Dwell, forces: Floats, creep: float) -> tuple[Floats, Floats]:
    """(n,) forces without creep, N, and (n,) decades of creep in each."""
    state, found = ForceCreep(creep), []
    for t, force in zip(dwell.t_s.tolist(), forces.tolist(), strict=True):
        now = state.step(t, force)
        found.append((now, state.decades_n / now if now > 0.0 else 0.0))
    without, decades = np.array(found).T
    return without, decades


def _creep(dwells: Sequence[Dwell], forces: Sequence[Floats], units: Sequence[float]) -> tuple[float, float]:
    """Growth per decade and its standard deviation, from the long touches and the prior."""
    long = [i for i, d in enumerate(dwells) if d.t_s[-1] - d.t_s[0] >= LONG_TOUCH_S]
    mean, width = CREEP_PRIOR
    if not long:
        return mean, width
    creep = mean
    for _ in range(CREEP_ROUNDS):
        slopes, weights = [], []
        for i in long:
            force, decades = _followed(dwells[i], forces[i], creep)
            late = dwells[i].t_s - dwells[i].t_s[0] > FIRST_CREEP_S
            force, decades, push = force[late], decades[late], dwells[i].push[late]
            depth = units[i] * math.sqrt(float(force.mean())) + push - push.mean()
            left = np.log(force / np.square(depth))
            x = decades - decades.mean()
            slopes.append(float(x @ left / (x @ x)))
            weights.append(float(force.mean() * (x @ x)))  # the way errs less beside a greater depth
        creep += float(np.average(slopes, weights=weights))
    scatter = float(np.average((np.array(slopes) - np.average(slopes, weights=weights)) ** 2, weights=weights))
    sigma = math.hypot(MIN_CREEP_SIGMA, math.sqrt(scatter / max(len(long) - 1, 1)) if len(long) > 1 else width)
    share = width**2 / (width**2 + sigma**2)
    return max(mean + share * (creep - mean), 0.0), sigma * math.sqrt(share)


def _corrected(dwell: Dwell, forces: Floats, creep: float, *, full: bool) -> tuple[float, float]:
    """Mean force without creep, N, and mean decades of creep, of a whole touch or of what is fitted of it."""
    force, decades = _followed(dwell, forces, creep)
    t = dwell.t_s - dwell.t_s[0]
    part = t >= FIRST_IMAGE_S
    if not (full or dwell.to_and_fro):
        part &= t <= LAST_IMAGE_S  # what `Shown.push` is the mean of
    return float(force[part].mean()), float(decades[part].mean())


def _scatter(touches: Sequence[Shown], forces: Floats, units: Floats) -> Floats:
    """(n,) relative errors of the force against the arm's way, held out, with one height and slope for each object."""
    depths, names = units * np.sqrt(forces), np.array([s.dwell.name for s in touches])
    push = np.array([s.push for s in touches])
    of_name = np.stack([names == name for name in dict.fromkeys(names.tolist())], axis=1).astype(float)
    columns = np.column_stack([depths, of_name])
    found, *_ = np.linalg.lstsq(columns, push, rcond=None)
    leverage = np.einsum("ij,ji->i", columns, np.linalg.pinv(columns))
    # over 1 − leverage: the residual of a fit without this touch; the force goes with δ², and errs by twice as much
    left: Floats = (push - columns @ found) / np.maximum(1.0 - leverage, 0.1)
    errors: Floats = 2.0 * left / (found[0] * depths)
    return errors


def stiffness_by_depth(
    touches: Sequence[Shown], forces: Sequence[float], radius: float, by_images: tuple[float, float]
) -> tuple[float, float, float, float]:
    """Stiffness by the arm's way between touches of one place with different forces, and the arm's compliance.

    On a stiff arm the way between two forces at one place is that of the layer, `δ = √(2 F √det A / (π k))`. The part
    of the way beyond the stiffness that the images show grows with the force: it is the arm's compliance. Its σ is that
    of the scatter of the ways and of the images' stiffness.

    Args:
        touches: the touches.
        forces: their forces, N.
        radius: radius of the probe, m.
        by_images: stiffness K/h from the images and its σ, N/m³.

    Returns:
        K/h and its σ (N/m³), compliance and its σ (m/N); NaN where no place was touched with two forces.
    """
    stiffness, stiffness_sigma = by_images
    rows = []
    places = [(s.dwell.name, s.dwell.place, s.dwell.turn) for s in touches]
    for there in sorted(set(places)):
        group = [i for i, place in enumerate(places) if place == there]
        if len(group) < 2:
            continue
        unit = np.array([indentation_from_force(forces[i], 1.0, radius, touches[i].dwell.kappa) for i in group])
        push, force = np.array([touches[i].push for i in group]), np.array([forces[i] for i in group])
        rows += list(zip(unit - unit.mean(), force - force.mean(), push - push.mean(), strict=True))
    if not rows:
        return (math.nan,) * 4
    unit, force, push = np.array(rows).T
    root = float(unit @ push / (unit @ unit))
    sigma = math.sqrt(float(np.mean((push - root * unit) ** 2)) / float(unit @ unit))
    more = push - unit / math.sqrt(stiffness)
    compliance = float(force @ more / (force @ force))
    scatter = math.sqrt(float(np.mean((more - compliance * force) ** 2)) / float(force @ force))
    of_stiffness = 0.5 * stiffness_sigma * stiffness**-1.5 * abs(float(force @ unit)) / float(force @ force)
    compliance_sigma = math.hypot(scatter, of_stiffness)
    if root <= 0.0:
        return math.nan, math.nan, compliance, compliance_sigma
    return root**-2, 2.0 * sigma / root**3, compliance, compliance_sigma
