"""Fits the gain of each taxel to images of known touches, and finds dead taxels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.touch.patch.image_fit import Dwell, Shown
from canprobe.mechanics.touch.patch.image_model import STEPS_PER_PITCH, ImageModel
from canprobe.mechanics.types import Floats


def taxel_gains(
    pad: Pad, model: ImageModel, dwells: Sequence[Dwell], shown: Sequence[Shown], forces: Sequence[float]
) -> tuple[Floats, tuple[tuple[int, int], ...]]:
    """Gain of each taxel over the mean, and dead taxels.

    The model's image is placed on the centroid of each image; taxels above a quarter of its peak are used.

    Args:
        pad: the taxels.
        model: the image model.
        dwells, shown: the touches.
        forces: their forces, N.

    Returns:
        (rows, columns) gains, 1 where nothing is known; (row, column) of dead taxels.
    """
    from scipy.ndimage import map_coordinates  # late: only a calibration needs it, and it takes long to load

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
