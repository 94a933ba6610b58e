"""The touched object as a sheet or a body of triangles, every vertex on its exact surface."""

from __future__ import annotations

import math

import numpy as np

from canprobe.bridge.view.meshes import Array, Mesh, dome, grid
from canprobe.touch.objects import Bowl, Cylinder, PlacedShape, Sphere

REACH_M = 0.055
"""How much of a surface without end is shown round the object's origin, to each side."""
WHOLE_M = 0.12
"""Largest radius of a body that is shown whole."""
STEPS = 40


def object_mesh(shape: PlacedShape, reach_m: float = REACH_M) -> Mesh:
    """The surface of an object near its origin, base frame.

    Balls, cylinders and bowls of ordinary size are shown whole (a cylinder over `reach_m` to each side), everything
    else over a square of twice `reach_m`.

    Args:
        shape: the true object.
        reach_m: m.
    """
    radius = getattr(shape, "radius", math.inf)
    if radius <= WHOLE_M and isinstance(shape, Sphere):
        return _placed(shape, dome(radius, math.pi, rings=32), -radius)
    if radius <= WHOLE_M and isinstance(shape, Cylinder):
        return _placed(shape, _tube(radius, reach_m), -radius)
    if radius <= WHOLE_M and isinstance(shape, Bowl):
        return _placed(shape, _hollow(radius), radius)
    return grid(_sheet(shape, reach_m))


def object_lines(shape: PlacedShape, reach_m: float = REACH_M, lines: int = 15) -> Array:
    """Lines on the surface that make its curvature visible.

    Args:
        shape: the true object.
        reach_m: to each side of the object's origin, m.
        lines: in each of two directions.

    Returns:
        (n, 2, 3) segments, base frame, m.
    """
    sheet = _sheet(shape, _sheet_reach(shape, reach_m))
    picked = np.linspace(0, STEPS, lines).round().astype(int)
    along = [np.stack([sheet[i, :-1], sheet[i, 1:]], axis=1) for i in picked]
    across = [np.stack([sheet[:-1, j], sheet[1:, j]], axis=1) for j in picked]
    return np.concatenate([*along, *across])


def _sheet_reach(shape: PlacedShape, reach_m: float) -> float:
    """Not over the edge of a body seen from above."""
    radius = getattr(shape, "radius", math.inf)
    return min(reach_m, 0.7 * radius) if not isinstance(shape, Cylinder) else reach_m


def _sheet(shape: PlacedShape, reach_m: float) -> Array:
    """(STEPS + 1, STEPS + 1, 3) feet of a square of the tangent plane, base frame; its front side is outside."""
    T = shape.T_base_object
    across = min(reach_m, 0.85 * shape.radius) if isinstance(shape, Cylinder) else reach_m
    xs, ys = np.linspace(-reach_m, reach_m, STEPS + 1), np.linspace(-across, across, STEPS + 1)
    plane = [[T[:3, 3] + x * T[:3, 0] + y * T[:3, 1] for y in ys] for x in xs]
    return np.array([[shape.closest(point).point for point in row] for row in plane])


def _placed(shape: PlacedShape, mesh: Mesh, height_m: float) -> Mesh:
    T = np.array(shape.T_base_object)
    T[:3, 3] += height_m * T[:3, 2]
    return mesh.moved(T)


def _tube(radius: float, half: float) -> Mesh:
    """A cylinder along x, open at its ends."""
    angles = np.linspace(0.0, 2.0 * math.pi, 97)
    y, z = radius * np.cos(angles), radius * np.sin(angles)
    ends = [np.column_stack([np.full(len(angles), x), y, z]) for x in np.linspace(-half, half, 9)]
    return grid(np.stack(ends, axis=1))


def _hollow(radius: float) -> Mesh:
    """The inside of the lower half of a ball."""
    half = dome(radius, math.pi / 2)
    return Mesh(half.vertices * (1.0, -1.0, -1.0), half.faces[:, ::-1])
