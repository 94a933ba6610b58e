"""The touched object as a sheet or a body of triangles, every vertex on its exact surface."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from canprobe.lab.bridge.view.meshes import arc, revolved, sheet
from canprobe.mechanics.touch.heights import Heights
from canprobe.mechanics.touch.objects import Cylinder, Sphere
from canprobe.mechanics.touch.shapes import Bowl, PlacedShape, Torus, Wave
from canprobe.mechanics.touch.tangent_frames import homogeneous
from canprobe.mechanics.types import Floats

REACH_M = 0.055
"""Half width of the shown part of an infinite surface round the object's origin, m."""
WHOLE_M = 0.12
"""Largest radius of a body that is shown whole, m."""
STEPS = 40
LINES = 15
RELIEF = 161
"""Points along each side of a grid of heights."""


def object_mesh(shape: PlacedShape) -> Any:
    """The surface of an object near its origin, base frame, a `trimesh.Trimesh`.

    Balls, cylinders, bowls and rings of ordinary size are shown whole (a cylinder over `REACH_M` to each side),
    heights within `REACH_M`, everything else over a square of twice `REACH_M`.
    """
    T, radius = shape.T_base_object, getattr(shape, "radius", math.inf)
    if isinstance(shape, Sphere) and radius <= WHOLE_M:
        return revolved(arc(radius, -math.pi / 2, math.pi / 2, 32), T @ _at(z=-radius))
    if isinstance(shape, Cylinder) and radius <= WHOLE_M:
        sides = np.column_stack([np.full(9, radius), np.linspace(-REACH_M, REACH_M, 9)])
        return revolved(sides, T @ _at(z=-radius) @ _ALONG_X)
    if isinstance(shape, Bowl) and radius <= WHOLE_M:  # the inside of the lower half of a ball
        return revolved(arc(radius, 0.0, -math.pi / 2, 24), T @ _at(z=radius))
    if isinstance(shape, Torus) and shape.ring_radius + radius <= WHOLE_M:
        ring = np.add(arc(radius, -math.pi, math.pi, 48), (shape.ring_radius, 0.0))
        return revolved(ring, T @ _at(x=-shape.ring_radius, z=-radius))
    mesh = sheet(_sheet(shape, REACH_M))
    mesh.update_faces(np.isfinite(mesh.triangles).all(axis=(1, 2)))
    mesh.remove_unreferenced_vertices()
    return mesh


_ALONG_X = homogeneous(np.array(((0, 0, 1), (0, 1, 0), (-1, 0, 0))), (0.0, 0.0, 0.0))
"""Carries a body along z to one along x."""


def _at(x: float = 0.0, z: float = 0.0) -> Floats:
    return homogeneous(np.eye(3), (x, 0.0, z))


def object_lines(shape: PlacedShape) -> Floats:
    """Lines on the surface in two directions, which show its curvature: segments (n, 2, 3), base frame, m."""
    radius = math.inf if isinstance(shape, Cylinder) else getattr(shape, "radius", math.inf)
    points = _sheet(shape, min(REACH_M, 0.7 * radius))  # not over the edge of a body seen from above
    rows, columns = (np.linspace(0, n - 1, LINES).round().astype(int) for n in points.shape[:2])
    along = [np.stack([points[i, :-1], points[i, 1:]], axis=1) for i in rows]
    across = [np.stack([points[:-1, j], points[1:, j]], axis=1) for j in columns]
    lines: Floats = np.concatenate([*along, *across])
    return lines[np.isfinite(lines).all(axis=(1, 2))]


def _relief(shape: Heights) -> Floats:
    """Points (m, n, 3) of heights within `REACH_M` of the origin, base frame; NaN where there is no surface."""
    x, y = (
        np.linspace(max(low, -REACH_M), min(high, REACH_M), RELIEF)
        for low, high in zip(shape.spline.corner, shape.spline.far, strict=True)
    )
    x, y = (one.ravel() for one in np.meshgrid(x, y, indexing="ij"))
    local = np.column_stack((x, y, shape.spline.many(x, y)[0]))
    T = shape.T_base_object
    points = np.where(shape.exists(x, y)[:, None], local @ T[:3, :3].T + T[:3, 3], np.nan)
    return points.reshape(RELIEF, RELIEF, 3)


def _sheet(shape: PlacedShape, reach_m: float) -> Floats:
    """A grid (m, n, 3) of the surface, base frame: feet of a square of the tangent plane; its front side is outside."""
    if isinstance(shape, Heights):
        return _relief(shape)
    T = shape.T_base_object
    across = min(reach_m, 0.85 * shape.radius) if isinstance(shape, Cylinder) else reach_m
    xs, ys = np.linspace(-reach_m, reach_m, STEPS + 1), np.linspace(-across, across, STEPS + 1)
    plane = [[T[:3, 3] + x * T[:3, 0] + y * T[:3, 1] + _height(shape, y) * T[:3, 2] for y in ys] for x in xs]
    return np.array([[shape.closest(point).point for point in row] for row in plane])


def _height(shape: PlacedShape, y: float) -> float:
    """Height at which the search for a foot begins, in the troughs too."""
    if isinstance(shape, Wave):
        return shape.amplitude * (math.cos(2.0 * math.pi * y / shape.wavelength) - 1.0)
    return 0.0
