"""Calibrate the array as a laboratory would, its force and the second moments of its images, from presses on known
shapes.

Every press has an array of its own (gains), principal curvatures, a direction on the pad, a force and a place by
chance, and lasts some seconds under a force that is a little restless; half of them stand still, half roll slowly over
the pad. The fit is of the form that `canprobe.touch.patch.moments` states; its floor is what remains of single presses,
so it holds gains, hysteresis, creep and the form of the model, and no averaging makes it smaller.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.emulator.array import follow
from canprobe.emulator.plant.probe import depth_for_force
from canprobe.emulator.plant.taxels import Image, TaxelArray, TaxelConfig
from canprobe.touch.pad import Pad
from canprobe.touch.patch.array_model import array_calibration
from canprobe.touch.patch.image import PatchCalibration, calibrate_force, compute_patch
from canprobe.touch.patch.moments import MomentFit, MomentImage, MomentModel, PadMemory, terms

# Calibrate the second moments of the array's images: press known curvatures, roll or stand, fit the sensor's model.

Array = NDArray[np.float64]
KAPPA = (-12.0, 60.0)
"""Range of both principal curvatures, 1/m."""
FORCE_N = (0.7, 3.2)
OFFSET_M = 2e-3
ROLL_M = 1.5e-3
ROLL_HZ = (0.35, 1.0)
LOADING_S = 0.5
PRESS_S = (2.5, 12.0)
AVERAGE_S = 1.0
UNREST, UNREST_S = 0.03, 0.1
"""The force wanders under a servo: relative standard deviation, and correlation time."""
FRAME_S = 0.04
LONGEST = {True: 3.2, False: 5.0}
"""Largest ideal moment over the squared pitch that is used, with the 8×8 window and with the whole pad."""
CHI2_95_OF_4 = 9.488
_FLAT = MomentFit(
    (0.0,) * len(terms(0.0, 0.0, 0.0)), 1.0, tuple(map(tuple, np.eye(4).tolist())), 0.0, (0.0, np.inf), (0.0, np.inf)
)


class Press(NamedTuple):
    """One press: what was true and what the images said.

    Attributes:
        kappa: (2,) principal curvatures, 1/m.
        force: N.
        moments: (2, 2) mean of the second moments in the principal axes, m².
        remembered: (2, 2) mean of the ways to where the patch was before (`PadMemory`), in the same axes, m².
        measured_force: mean, N.
        frame_sigma: relative standard deviation of the moments of single frames.
    """

    kappa: Array
    force: float
    moments: Array
    remembered: Array
    measured_force: float
    frame_sigma: float


def random_presses(n: int, seed: int, full_scale_pa: float, *, windowed: bool) -> Iterator[Press]:
    """Presses of n arrays.

    Args:
        n: how many.
        seed: of everything.
        full_scale_pa: of the arrays.
        windowed: only the 8×8 window that follows the contact is seen.
    """
    rng = np.random.default_rng(seed)
    calibration = array_calibration(Pad(full_scale_pa=full_scale_pa))
    moment_image = MomentImage(calibration)
    for i in range(n):
        kappa = np.sort(rng.uniform(*KAPPA, 2))[::-1]
        force, angle = float(rng.uniform(*FORCE_N)), float(rng.uniform(0.0, np.pi))
        axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        array = TaxelArray(TaxelConfig(full_scale_pa=full_scale_pa), rng)
        pressed = list(_images(array, rng, kappa, force, axes, full_scale_pa, rolling=bool(i % 2), windowed=windowed))
        times, images, forces = zip(*pressed, strict=True)
        patches = [compute_patch(image, calibration) for image in images]
        last = int(np.searchsorted(times, times[-1] + FRAME_S - AVERAGE_S - 1e-9))
        if any(p.saturated or p.cut_by_pad for p in patches[last:]):
            continue
        memory = PadMemory()
        ways = [memory.add(t, p.u, p.v) for t, p in zip(times, patches, strict=True) if p.n_active]
        seen = np.array([moment_image.moments(image) for image in images[last:]])
        V, D = (axes @ np.asarray(x)[:, [[0, 1], [1, 2]]] @ axes.T for x in (seen, ways[-len(seen) :]))
        patches, forces = patches[last:], forces[last:]
        spread = np.diagonal(np.diff(V, axis=0), axis1=1, axis2=2) / np.diagonal(V.mean(axis=0))
        yield Press(
            kappa,
            float(np.mean(forces)),
            V.mean(axis=0),
            D.mean(axis=0),
            float(np.mean([p.force for p in patches])),
            float(spread.std() / np.sqrt(2.0)),
        )


def _images(  # noqa: PLR0917
    array: TaxelArray,
    rng: np.random.Generator,
    kappa: Array,
    force: float,
    axes: Array,
    full_scale_pa: float,
    *,
    rolling: bool,
    windowed: bool,
) -> Iterator[tuple[float, Image, float]]:
    """Time (s), image and force (N) through one press."""
    calibration = array_calibration(Pad(full_scale_pa=full_scale_pa))
    k = (float(kappa[0]), float(kappa[1]))
    depth = depth_for_force(force, k, calibration.radius_m, 1.27e8)
    place, heading = rng.uniform(-OFFSET_M, OFFSET_M, 2), float(rng.uniform(0.0, 2.0 * np.pi))
    hz, roll, origin = float(rng.choice(ROLL_HZ)), ROLL_M if rolling else 0.0, (4, 4)
    c, s = np.cos(heading), np.sin(heading)
    duration, unrest, kept = float(rng.uniform(*PRESS_S)), 0.0, float(np.exp(-FRAME_S / UNREST_S))
    for t in np.arange(0.0, duration, FRAME_S).tolist():
        unrest = kept * unrest + UNREST * np.sqrt(1.0 - kept**2) * float(rng.standard_normal())
        phase = 2.0 * np.pi * hz * max(0.0, t - LOADING_S)
        x, y = roll * np.sin(phase), 0.4 * roll * np.sin(2.0 * phase)
        uv = (float(place[0] + c * x - s * y), float(place[1] + s * x + c * y))
        now = force * min(1.0, t / LOADING_S) * (1.0 + unrest)
        image = array.image(uv, depth * float(np.sqrt(now / force)), k, axes, t)
        if windowed:
            origin = follow(image, origin)
            seen = np.zeros_like(image)
            part = np.s_[origin[0] : origin[0] + 8, origin[1] : origin[1] + 8]
            seen[part] = image[part]
            image = seen
        yield t, image, now


def sensor(full_scale_pa: float, fit: MomentFit = _FLAT) -> MomentModel:
    """The model of such an array on the standard probe."""
    calibration = array_calibration(Pad(full_scale_pa=full_scale_pa))
    return MomentModel(fit, calibration.radius_m, 1.27e8, MomentImage(calibration).level_pa)


def ideal_moments(presses: Sequence[Press], model: MomentModel) -> tuple[Array, Array]:
    """(n, 2) moments of the ideal layer over the squared pitch, and (n,) level over peak pressure."""
    ideal = [model.ideal((p.kappa[0], 0.0, p.kappa[1]), p.force) for p in presses]
    return np.array([[m[0], m[2]] for m, _ in ideal]), np.array([t for _, t in ideal])


def fit_moments(presses: Sequence[Press], full_scale_pa: float, *, windowed: bool) -> MomentFit:
    """The calibration that these presses make, in least squares of relative errors."""
    model = sensor(full_scale_pa)
    m, t = ideal_moments(presses, model)
    used = m.max(axis=1) <= LONGEST[windowed]
    m, t = m[used], t[used]
    V = np.array([p.moments for p in presses])[used] / model.pitch**2
    seen = np.diagonal(V, axis1=1, axis2=2)
    D = np.array([p.remembered for p in presses])[used] / model.pitch**2
    basis = np.stack([_basis(m[:, 0], m[:, 1], t), _basis(m[:, 1], m[:, 0], t)], axis=1)
    basis = np.concatenate([basis, np.diagonal(D, axis1=1, axis2=2)[:, :, None]], axis=2)
    rows = (basis / seen[:, :, None]).reshape(-1, basis.shape[2])
    c, *_ = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)
    errors = seen / (basis @ c) - 1.0
    shear = (V - c[-1] * D)[:, 0, 1] / np.sqrt(seen.prod(axis=1))
    ratio = np.array([p.measured_force / p.force for p in presses])[used]
    return MomentFit(
        tuple(c[:-1].tolist()),
        float(ratio.mean()),
        tuple(map(tuple, _floor(np.column_stack([errors, shear, ratio / ratio.mean() - 1.0]), t).tolist())),
        float(np.median([p.frame_sigma for p in presses])),
        (float(m.min()), float(m.max())),
        (float(t.min()), float(t.max())),
        float(c[-1]),
    )


def _basis(mi: Array, mj: Array, t: Array) -> Array:
    return np.stack(terms(mi, mj, t), axis=1)


def _floor(errors: Array, t: Array) -> Array:
    """(4, 4) covariance, the same for both axes of the patch, of errors (n, 4) whose variance grows with t (n,).

    Their tails are longer than a normal distribution's: it is made so large that its 95 % region holds 95 % of them.
    """
    scaled = errors * np.sqrt(math.sqrt(float(t.min() * t.max())) / t)[:, None]
    C = scaled.T @ scaled / len(scaled)
    C[0, 0] = C[1, 1] = 0.5 * (C[0, 0] + C[1, 1])
    C[0, 3] = C[3, 0] = C[1, 3] = C[3, 1] = 0.5 * (C[0, 3] + C[1, 3])
    C[2, [0, 1, 3]] = C[[0, 1, 3], 2] = 0.0
    squares = np.einsum("ij,ij->i", scaled, np.linalg.solve(C, scaled.T).T)
    result: Array = C * max(1.0, float(np.quantile(squares, 0.95)) / CHI2_95_OF_4)
    return result


# Calibrate the array's force as a laboratory would: press known loads, roll a little, wait, fit two numbers.
#
# What it corrects on average over arrays: threshold, blur, saturation, mean hysteresis and creep after some seconds of
# contact. What it cannot: the gains of one array, and where in its hysteresis loop a taxel is. A load that was only
# ever pressed, never rolled, reads about 5 % less: every taxel is then on the loading side of its loop.

KAPPAS = ((0.0, 0.0), (20.0, 20.0), (1 / 0.036, 0.0), (16.0, -12.0))
"""Curvatures that are pressed (1/m): plane, sphere, cylinder, saddle."""
DWELL_S = 9.0
FORCE_AVERAGE_S = 3.0
FORCE_FRAME_S = 0.02
FORCE_ROLL_HZ = 0.35


def pressed_sums(
    full_scale_pa: float,
    forces: Sequence[float],
    seeds: Sequence[int],
    *,
    radius: float = 0.040,
    stiffness: float = 1.27e8,
) -> Iterator[tuple[float, float]]:
    """Pairs (plain sum of the image in N, true force in N) of presses after some seconds of contact.

    Args:
        full_scale_pa: of the array.
        forces: N.
        seeds: one array each.
        radius: of the probe, m.
        stiffness: K/h of its layer, N/m³.
    """
    plain = PatchCalibration(Pad(full_scale_pa=full_scale_pa, mount_radius_m=radius))
    for seed in seeds:
        rng = np.random.default_rng(seed)
        for kappa in KAPPAS:
            for force in forces:
                array = TaxelArray(
                    TaxelConfig(full_scale_pa=full_scale_pa), rng, radius_m=radius, stiffness_n_m3=stiffness
                )
                yield _press(array, plain, force, kappa, rng, radius=radius, stiffness=stiffness), force


def _press(
    array: TaxelArray,
    plain: PatchCalibration,
    force: float,
    kappa: tuple[float, float],
    rng: np.random.Generator,
    *,
    radius: float,
    stiffness: float,
) -> float:
    """Mean sum over the last three seconds of one press: a ramp, then a dwell with a slow roll."""
    depth = depth_for_force(force, kappa, radius, stiffness)
    u, v = rng.uniform(-OFFSET_M, OFFSET_M, 2).tolist()
    sums = []
    for t in np.arange(0.0, LOADING_S + DWELL_S, FORCE_FRAME_S):
        angle = 2 * np.pi * FORCE_ROLL_HZ * max(0.0, t - LOADING_S)
        uv = (u + ROLL_M * np.sin(angle), v + 0.4 * ROLL_M * np.sin(2 * angle))
        image = array.image(uv, depth * min(1.0, t / LOADING_S), kappa, np.eye(2), float(t))
        sums.append(compute_patch(image.astype(np.uint8), plain).force)
    return float(np.mean(sums[-round(FORCE_AVERAGE_S / FORCE_FRAME_S) :]))


def calibrate(full_scale_pa: float, seeds: Sequence[int], forces: Sequence[float]) -> PatchCalibration:
    """The mean calibration of arrays with this full scale."""
    sums, true = zip(*pressed_sums(full_scale_pa, forces, seeds), strict=True)
    return replace(calibrate_force(sums, true), pad=Pad(full_scale_pa=full_scale_pa))
