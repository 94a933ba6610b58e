"""What the panels of a surface figure share: the map, its tests, the true object, the plane of the scan."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.touch.consistency import LEVEL, Consistency
from canprobe.touch.frames import tangent_rotation
from canprobe.touch.objects import PlacedShape
from canprobe.touch.surface_map import SurfaceMap

Array = NDArray[np.float64]
MARGIN_M, GRID = 5e-3, 34
"""How far a drawn surface goes beyond a path, and its points a side."""


class MapView(NamedTuple):
    """A map as seen along its mean normal; `axes` (3, 3) rows along, across, outward, `origin` (3,) its middle, m."""

    map: SurfaceMap
    consistency: Consistency
    shape: PlacedShape | None
    axes: Array
    origin: Array

    def plane(self, points: Array) -> Array:
        """(n, 3) mm along, across, outward from the middle of the map."""
        result: Array = (points - self.origin) @ self.axes.T * 1e3
        return result


def view_of(surface_map: SurfaceMap, consistency: Consistency, shape: PlacedShape | None) -> MapView:
    """The view of a map with at least one patch and of its tests; `shape` is the true object or None."""
    path = surface_map.path if len(surface_map.path) else surface_map.points
    middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
    outward = surface_map.normals.mean(axis=0)
    R = tangent_rotation(outward / np.linalg.norm(outward))
    flat = (path - middle) @ R[:, :2]
    _, _, main = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    along = R[:, :2] @ main[0]
    axes = np.array([along, np.cross(R[:, 2], along), R[:, 2]])
    return MapView(surface_map, consistency, shape, axes, middle)


def rejected(consistency: Consistency) -> NDArray[np.bool_]:
    """(n,) whether the joint test of each crossing rejects one surface."""
    return np.array([c.joint.p < LEVEL for c in consistency.crossings], dtype=bool)


def true_surface(shape: PlacedShape, path: Array, axes: Array, origin: Array) -> Array:
    """An object's surface below a path (n, 3): (3, GRID, GRID) mm along the rows of `axes` (3, 3) from `origin`."""
    flat = (path - origin) @ axes.T
    low, high = flat.min(axis=0) - MARGIN_M, flat.max(axis=0) + MARGIN_M
    us, vs = np.meshgrid(np.linspace(low[0], high[0], GRID), np.linspace(low[1], high[1], GRID))
    above = np.stack((us, vs, np.full_like(us, high[2])), axis=-1) @ axes + origin
    feet = np.array([shape.closest(point).point for point in above.reshape(-1, 3)])
    result: Array = ((feet - origin) @ axes.T * 1e3).T.reshape(3, GRID, GRID)
    return result
