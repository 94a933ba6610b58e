"""The tactile array on its dome: where each taxel lies, and its image as colours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from canprobe.bridge.view.colours import Colours, heat
from canprobe.bridge.view.meshes import Array
from canprobe.protocol.tactile import SIDE
from canprobe.touch.contact import pad_to_direction
from canprobe.touch.patch import PatchCalibration

FULL_COUNTS = 255
SHARE = 0.9
"""Side of a drawn taxel over the pitch."""
LIFT_M = 2e-4
"""How far above the dome taxels are drawn."""


def taxel_poses(radius: float) -> tuple[Array, Array]:
    """Where the taxels lie on the probe.

    Args:
        radius: of the probe, m.

    Returns:
        (256, 3) positions in the probe frame, m, and (256, 4) unit quaternions w, x, y, z that turn a tile lying in
        the xy plane to its place; row by row, v and then u rising.
    """
    pitch = PatchCalibration().pitch_m
    axis = (np.arange(SIDE) - 0.5 * (SIDE - 1)) * pitch
    directions = np.array([pad_to_direction(u, v, radius) for v in axis for u in axis])
    # the shortest turn from z to d: (1 + d_z, z × d), normalised
    turns = np.column_stack([1.0 + directions[:, 2], -directions[:, 1], directions[:, 0], np.zeros(len(directions))])
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    return (radius + LIFT_M) * directions, turns


def tile() -> tuple[Array, NDArray[np.int64]]:
    """One taxel: vertices (4, 3), m, and faces (2, 3), front side towards +z."""
    half = 0.5 * SHARE * PatchCalibration().pitch_m
    corners = half * np.array(((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)), dtype=np.float64)
    return corners, np.array(((0, 1, 2), (0, 2, 3)))


def taxel_colours(taxels: NDArray[np.uint8]) -> Colours:
    """(..., 3) colours of counts; a square-root scale, so that the rim of a patch is seen."""
    return heat(np.sqrt(taxels.astype(np.float64)), 0.0, np.sqrt(FULL_COUNTS))


def taxel_image(taxels: NDArray[np.uint8], pixels: int = 12) -> Colours:
    """The image as RGB, each taxel a square of so many pixels; v rises upward.

    Args:
        taxels: (16, 16) counts, rows v, columns u.
        pixels: per taxel.
    """
    colours = taxel_colours(taxels[::-1])
    return np.repeat(np.repeat(colours, pixels, axis=0), pixels, axis=1)
