"""Common data of the panels of a surface figure: the map, the path, the true object, the plane of the scan."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.spatial import cKDTree

from canprobe.mechanics.touch.map.surface_map import REACH_M, SurfaceMap
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.touch.tangent_frames import tangent_rotation
from canprobe.mechanics.types import Floats

MARGIN_M, TRUE_POINTS = 5e-3, 34
"""Margin of a true surface beyond the path, m, and its points on each side."""
MAP_POINTS = 64
"""Number of points of a map's surface along its longer side."""


class MapView(NamedTuple):
    """A map, the path (n, 3), m, of the contact or None, the true object or None, and the plane of the drawing."""

    map: SurfaceMap
    path: Floats | None
    shape: PlacedShape | None
    plane: MapPlane


class MapPlane(NamedTuple):
    """The plane of a scan: `axes` (3, 3), rows along, across, outward, and `origin` (3,), the middle of the path, m."""

    axes: Floats
    origin: Floats

    @classmethod
    def of(cls, path: Floats, normals: Floats) -> MapPlane:
        """Find the plane of a path (n, 3), m, with outward normals (m, 3) along it."""
        middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
        outward = normals.mean(axis=0)
        R = tangent_rotation(outward / np.linalg.norm(outward))
        flat = (path - middle) @ R[:, :2]
        _, _, main = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
        along = R[:, :2] @ main[0]
        return cls(np.array([along, np.cross(R[:, 2], along), R[:, 2]]), middle)

    def mm(self, points: Floats) -> Floats:
        """Points (..., 3) of base, m, as mm along, across, outward."""
        result: Floats = (points - self.origin) @ self.axes.T * 1e3
        return result

    def base(self, mm: Floats) -> Floats:
        """Points (..., 3) in mm along, across, outward, as points of base, m."""
        result: Floats = 1e-3 * mm @ self.axes + self.origin
        return result


def true_surface(shape: PlacedShape, path: Floats, plane: MapPlane) -> Floats:
    """An object's surface below a path (n, 3): (TRUE_POINTS, TRUE_POINTS, 3) points of base, m."""
    flat = plane.mm(path)
    low, high = flat.min(axis=0) - 1e3 * MARGIN_M, flat.max(axis=0) + 1e3 * MARGIN_M
    us, vs = np.meshgrid(np.linspace(low[0], high[0], TRUE_POINTS), np.linspace(low[1], high[1], TRUE_POINTS))
    above = plane.base(np.stack((us, vs, np.full_like(us, high[2])), axis=-1))
    return np.array([shape.closest(point).point for point in above.reshape(-1, 3)]).reshape(TRUE_POINTS, TRUE_POINTS, 3)


def map_surface(surface_map: SurfaceMap, plane: MapPlane) -> tuple[Floats, Floats]:
    """The surface of a map: points (rows, columns, 3) of base, m, and its σ there, m; NaN beyond its contacts.

    A grid over the plane of the scan, in a tenth of the time of the triangles that `SurfaceMap.mesh` finds.
    """
    contacts = plane.mm(surface_map.points)
    low, high = contacts.min(axis=0)[:2] - 1e3 * REACH_M, contacts.max(axis=0)[:2] + 1e3 * REACH_M
    counts = np.ceil(MAP_POINTS * (high - low) / (high - low).max()).astype(int)
    us, vs = np.meshgrid(*(np.linspace(*ends) for ends in zip(low, high, counts, strict=True)))
    nearest = cKDTree(contacts[:, :2]).query(np.stack((us, vs), axis=-1))[1]
    feet = surface_map.closest(plane.base(np.stack((us, vs, contacts[nearest, 2]), axis=-1)).reshape(-1, 3))
    return feet.point.reshape(*us.shape, 3), feet.sigma.reshape(us.shape)


def add_sheet(axes: Any, corners: Floats, colours: Floats | str, **style: Any) -> None:
    """Draw the cells of a grid (rows, columns, 3) that are known at all corners; a colour, or (rows, columns, 4)."""
    cells = np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]], axis=2).reshape(-1, 4, 3)
    known = np.isfinite(cells).all(axis=(1, 2))
    faces = colours if isinstance(colours, str) else colours[:-1, :-1].reshape(-1, 4)[known]
    axes.add_collection3d(
        Poly3DCollection(cells[known], facecolors=faces, linewidths=0, antialiased=False, **style), autolim=False
    )
    axes.auto_scale_xyz(*cells[known].reshape(-1, 3).T)
