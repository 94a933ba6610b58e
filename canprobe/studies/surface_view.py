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
INK, FAINT, GHOST, ACCENT, SECOND, THIRD = "#1f2933", "#d9dee4", "#8a94a0", "#c2410c", "#0f6e84", "#6b4fa0"


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
