"""The touched object as a sheet or a body of triangles, every vertex on its exact surface."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.lab.bridge.view.meshes import TriangleMesh, dome, grid, revolved
from canprobe.mechanics.touch.heights import Heights
from canprobe.mechanics.touch.objects import Cylinder, Sphere
from canprobe.mechanics.touch.shapes import Bowl, PlacedShape, Torus, Wave
from canprobe.mechanics.types import Floats

REACH_M = 0.055
"""Half width of the shown part of an infinite surface round the object's origin, m."""
WHOLE_M = 0.12
"""Largest radius of a body that is shown whole, m."""
STEPS = 40
LINES = 15
RELIEF = 161
"""Points along each side of a grid of heights."""


def object_mesh(shape: PlacedShape) -> TriangleMesh:
    """The surface of an object near its origin, base frame.

    Balls, cylinders, bowls and rings of ordinary size are shown whole (a cylinder over `REACH_M` to each side),
    heights within `REACH_M`, everything else over a square of twice `REACH_M`.
    """
    radius = getattr(shape, "radius", math.inf)
    if radius <= WHOLE_M and isinstance(shape, Sphere):
        return _placed(shape, dome(radius, math.pi, rings=32), -radius)
    if radius <= WHOLE_M and isinstance(shape, Cylinder):
        return _placed(shape, _tube(radius, REACH_M), -radius)
    if radius <= WHOLE_M and isinstance(shape, Bowl):
        return _placed(shape, _hollow(radius), radius)
    if isinstance(shape, Heights):
        points, exists = _relief(shape)
        mesh = grid(points)
        used, faces = np.unique(mesh.faces[exists.ravel()[mesh.faces].all(axis=1)], return_inverse=True)
        return TriangleMesh(mesh.vertices[used], faces.reshape(-1, 3))
    if isinstance(shape, Torus) and shape.ring_radius + radius <= WHOLE_M:
        return _ring(shape)
    return grid(_sheet(shape, REACH_M))


def object_lines(shape: PlacedShape) -> Floats:
    """Lines on the surface in two directions, which show its curvature: segments (n, 2, 3), base frame, m."""
    radius = math.inf if isinstance(shape, Cylinder) else getattr(shape, "radius", math.inf)
    if isinstance(shape, Heights):
        points, exists = _relief(shape)
        lines = _lines(np.where(exists[..., None], points, np.nan))
        return lines[np.isfinite(lines).all(axis=(1, 2))]
    sheet = _sheet(shape, min(REACH_M, 0.7 * radius))  # not over the edge of a body seen from above
    return _lines(sheet)


def _lines(sheet: Floats) -> Floats:
    rows, columns = (np.linspace(0, n - 1, LINES).round().astype(int) for n in sheet.shape[:2])
    along = [np.stack([sheet[i, :-1], sheet[i, 1:]], axis=1) for i in rows]
    across = [np.stack([sheet[:-1, j], sheet[1:, j]], axis=1) for j in columns]
    return np.concatenate([*along, *across])


def _relief(shape: Heights) -> tuple[Floats, NDArray[np.bool_]]:
    """Points (m, n, 3) of heights within `REACH_M` of the origin, base frame, and whether the surface exists (m, n)."""
    x, y = (
        np.linspace(max(low, -REACH_M), min(high, REACH_M), RELIEF)
        for low, high in zip(shape.spline.corner, shape.spline.far, strict=True)
    )
    x, y = (one.ravel() for one in np.meshgrid(x, y, indexing="ij"))
    local = np.column_stack((x, y, shape.spline.many(x, y)[0]))
    T = shape.T_base_object
    points: Floats = (local @ T[:3, :3].T + T[:3, 3]).reshape(RELIEF, RELIEF, 3)
    return points, shape.exists(x, y).reshape(RELIEF, RELIEF)


def _sheet(shape: PlacedShape, reach_m: float) -> Floats:
    """Feet (STEPS + 1, STEPS + 1, 3) of a square of the tangent plane, base frame; its front side is outside."""
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


def _ring(shape: Torus) -> TriangleMesh:
    """A whole torus."""
    angle = np.linspace(-math.pi, math.pi, 49)
    profile = np.column_stack([shape.ring_radius + shape.radius * np.cos(angle), shape.radius * np.sin(angle)])
    mesh = revolved(profile, 96)
    return _placed(shape, TriangleMesh(mesh.vertices - (shape.ring_radius, 0.0, 0.0), mesh.faces), -shape.radius)


def _placed(shape: PlacedShape, mesh: TriangleMesh, height_m: float) -> TriangleMesh:
    T = np.array(shape.T_base_object)
    T[:3, 3] += height_m * T[:3, 2]
    return mesh.moved(T)


def _tube(radius: float, half: float) -> TriangleMesh:
    """A cylinder along x, open at its ends."""
    angles = np.linspace(0.0, 2.0 * math.pi, 97)
    y, z = radius * np.cos(angles), radius * np.sin(angles)
    ends = [np.column_stack([np.full(len(angles), x), y, z]) for x in np.linspace(-half, half, 9)]
    return grid(np.stack(ends, axis=1))


def _hollow(radius: float) -> TriangleMesh:
    """The inside of the lower half of a ball."""
    half = dome(radius, math.pi / 2)
    return TriangleMesh(half.vertices * (1.0, -1.0, -1.0), half.faces[:, ::-1])
