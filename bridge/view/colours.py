"""Colours of numbers on a scale that looks even, dark blue to yellow."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from canprobe.mechanics.types import Floats

Colours = NDArray[np.uint8]
VIRIDIS = np.array(
    (
        (68, 1, 84), (71, 44, 122), (59, 81, 139), (44, 113, 142), (33, 144, 141),
        (39, 173, 129), (92, 200, 99), (170, 220, 50), (253, 231, 37),
    ),
    dtype=np.float64,
)  # fmt: skip
"""Colours at ninths of the scale. Source: Smith and van der Walt, matplotlib 2.0, CC0."""
MAGMA = np.array(((0, 0, 4), (81, 18, 124), (183, 55, 121), (252, 137, 97), (252, 253, 191)), dtype=np.float64)
"""Colours at quarters of the scale, from the same source."""
UNKNOWN = (138, 148, 160)


def scale(values: ArrayLike, low: float, high: float, stops: Floats = VIRIDIS) -> Colours:
    """Colours of values between two limits; a value beyond has the colour of the limit, one that is not finite is grey.

    Args:
        values: values (...,) in any unit.
        low, high: limits of the scale in the same unit, low < high.
        stops: `VIRIDIS`, dark blue to yellow, or `MAGMA`, black to light yellow.

    Returns:
        Colours (..., 3), RGB, 0–255.
    """
    x = np.asarray(values, dtype=np.float64)
    known = np.isfinite(x)
    place = np.clip((np.where(known, x, low) - low) / (high - low), 0.0, 1.0) * (len(stops) - 1)
    mixed = np.stack([np.interp(place, np.arange(len(stops)), channel) for channel in stops.T], axis=-1)
    return np.where(known[..., None], mixed.round(), UNKNOWN).astype(np.uint8)


def linear_light(colours: Colours) -> Colours:
    """RGB as amounts of light, which viser expects for lines and batches; else they would look too bright.

    Source: IEC 61966-2-1 (sRGB), decoding.
    """
    x = colours.astype(np.float64) / 255.0
    light = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    return (255.0 * light).round().astype(np.uint8)
