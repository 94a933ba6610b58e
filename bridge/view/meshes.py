"""Triangle meshes of trimesh: surfaces of revolution, and sheets through grids of points.

Faces wind counter-clockwise seen from outside.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from canprobe.errors import needed_module
from canprobe.mechanics.types import Floats

SECTORS = 96


def trimesh() -> Any:
    """The package.

    Raises:
        UsageError: it is not installed.
    """
    return needed_module("trimesh", "view", "the view needs trimesh; type:")


def arc(radius: float, low_rad: float, high_rad: float, steps: int) -> Floats:
    """Profile (steps + 1, 2) of a part of a sphere about the origin, between two latitudes, for `revolved`."""
    latitude = np.linspace(low_rad, high_rad, steps + 1)
    return radius * np.column_stack([np.cos(latitude), np.sin(latitude)])


def revolved(profile: ArrayLike, T: Floats | None = None) -> Any:
    """A surface of revolution about z.

    Args:
        profile: rows (distance from the axis, height) (n, 2), m; the outside lies to its right.
        T: pose (4, 4) of the surface; by default it stays at the origin.
    """
    return trimesh().creation.revolve(profile, sections=SECTORS, transform=T)


def sheet(points: Floats) -> Any:
    """A sheet through a grid of points (rows, columns, 3); the front side is that of rows × columns directions."""
    index = np.arange(math.prod(points.shape[:2])).reshape(points.shape[:2])
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1).reshape(-1, 4)
    return trimesh().Trimesh(points.reshape(-1, 3), quads, process=False)
