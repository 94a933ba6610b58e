"""Calibrate the array's force as a laboratory would: press known loads, roll a little, wait, fit two numbers.

What it corrects on average over arrays: threshold, blur, saturation, mean hysteresis and creep after some seconds of
contact. What it cannot: the gains of one array, and where in its hysteresis loop a taxel is. A load that was only ever
pressed, never rolled, reads about 5 % less: every taxel is then on the loading side of its loop.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from canprobe.emulator.plant.contact import depth_for_force
from canprobe.emulator.plant.taxels import TaxelArray, TaxelConfig
from canprobe.touch.patch import PatchCalibration, calibrate_force, compute_patch

KAPPAS = ((0.0, 0.0), (20.0, 20.0), (1 / 0.036, 0.0), (16.0, -12.0))
"""Curvatures that are pressed (1/m): plane, sphere, cylinder, saddle."""
DWELL_S = 9.0
AVERAGE_S = 3.0
LOADING_S = 0.5
FRAME_S = 0.02
OFFSET_M = 2e-3
ROLL_M = 1.5e-3
"""Amplitude of the contact's slow wander over the pad, as in a scan that lets the pad follow the normal."""
ROLL_HZ = 0.35


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
    plain = PatchCalibration(full_scale_pa=full_scale_pa, radius_m=radius)
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
    for t in np.arange(0.0, LOADING_S + DWELL_S, FRAME_S):
        angle = 2 * np.pi * ROLL_HZ * max(0.0, t - LOADING_S)
        uv = (u + ROLL_M * np.sin(angle), v + 0.4 * ROLL_M * np.sin(2 * angle))
        image = array.image(uv, depth * min(1.0, t / LOADING_S), kappa, np.eye(2), float(t))
        sums.append(compute_patch(image.astype(np.uint8), plain).force)
    return float(np.mean(sums[-round(AVERAGE_S / FRAME_S) :]))


def calibrate(full_scale_pa: float, seeds: Sequence[int], forces: Sequence[float]) -> PatchCalibration:
    """The mean calibration of arrays with this full scale."""
    sums, true = zip(*pressed_sums(full_scale_pa, forces, seeds), strict=True)
    return replace(calibrate_force(sums, true), full_scale_pa=full_scale_pa)
