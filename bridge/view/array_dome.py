"""The probe: its holder and elastic dome, where each taxel of its array lies, and the image as colours."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.lab.bridge.view.colours import MAGMA, Colours, scale
from canprobe.lab.bridge.view.meshes import arc, revolved
from canprobe.mechanics.touch.contact import pad_to_direction
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.types import Floats

FULL_COUNTS = 255
TAXEL_SHARE = 0.9
"""Side of a drawn taxel over the pitch."""
TAXEL_LIFT_M = 2e-4
"""Height of the drawn taxels above the dome, m."""


def probe_parts(radius: float, T_flange_probe: Floats) -> tuple[Any, Any]:
    """The probe in its own frame (origin at the sphere's centre, z the pole): its holder, and its elastic dome.

    Args:
        radius: radius of the sphere, m.
        T_flange_probe: (4, 4); the holder goes back along z to the flange.
    """
    back = float(T_flange_probe[2, 3])
    r = radius
    outline = [(0.0, -back), (0.014, -back), (0.014, -0.72 * r), (0.62 * r, -0.42 * r), (0.9 * r, -0.42 * r)]
    holder = revolved([*outline, (0.9 * r, -0.34 * r), (0.0, -0.34 * r)])
    return holder, revolved(arc(radius, math.radians(-20.0), math.pi / 2, 24))


def taxel_poses(pad: Pad, radius: float) -> tuple[Floats, Floats]:
    """Poses of the taxels on the probe.

    Args:
        pad: the taxels.
        radius: distance from the origin of the probe's frame to its pole, m.

    Returns:
        Positions in the probe frame (n, 3), m, and unit quaternions w, x, y, z (n, 4) that turn a tile from the
        xy plane to its place; row by row, v and then u rising.
    """
    directions = np.array([pad_to_direction(u, v, pad.radius_m) for u, v in pad.uv.tolist()])
    # the shortest turn from z to d: (1 + d_z, z × d), normalised
    turns = np.column_stack([1.0 + directions[:, 2], -directions[:, 1], directions[:, 0], np.zeros(len(directions))])
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    pole = np.array([0.0, 0.0, radius - pad.radius_m])
    return pole + (pad.radius_m + TAXEL_LIFT_M) * directions, turns


def tile(pad: Pad) -> tuple[Floats, NDArray[np.int64]]:
    """One taxel: vertices (4, 3), m, and faces (2, 3), front side towards +z."""
    half = 0.5 * TAXEL_SHARE * pad.pitch_m
    corners = half * np.array(((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)), dtype=np.float64)
    return corners, np.array(((0, 1, 2), (0, 2, 3)))


def taxel_colours(taxels: NDArray[np.uint8]) -> Colours:
    """Colours (..., 3) of counts, on a square-root scale, so that the rim of a patch is visible."""
    return scale(np.sqrt(taxels.astype(np.float64)), 0.0, math.sqrt(FULL_COUNTS), MAGMA)


def taxel_image(taxels: NDArray[np.uint8], pixels: int) -> Colours:
    """The image as RGB, each taxel as a square; v rises upward.

    Args:
        taxels: counts (rows, columns), rows v, columns u.
        pixels: side of a taxel, pixels.
    """
    colours = taxel_colours(taxels[::-1])
    return np.repeat(np.repeat(colours, pixels, axis=0), pixels, axis=1)
