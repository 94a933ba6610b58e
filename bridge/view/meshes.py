"""Triangle meshes as plain arrays: prisms with rounded rims, solids of revolution, grids.

Faces wind counter-clockwise seen from outside. Vertices are doubled at edges, so that smooth shading stops there.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from canprobe.mechanics.types import Floats

Faces = NDArray[np.int64]

SECTORS = 48
Circle = tuple[tuple[float, float], float]
"""Centre (x, y) and radius, m."""


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh:
    """A triangle mesh.

    Attributes:
        vertices: positions (n, 3), m.
        faces: indices into the vertices (m, 3).
    """

    vertices: Floats
    faces: Faces

    def moved(self, T: Floats) -> TriangleMesh:
        """The mesh carried by a transform (4, 4)."""
        return TriangleMesh(self.vertices @ T[:3, :3].T + T[:3, 3], self.faces)


def merged(meshes: Iterable[TriangleMesh]) -> TriangleMesh:
    """Several meshes as one."""
    parts = list(meshes)
    starts = accumulate((len(mesh.vertices) for mesh in parts), initial=0)
    faces = [mesh.faces + start for mesh, start in zip(parts, starts, strict=False)]
    return TriangleMesh(np.concatenate([mesh.vertices for mesh in parts]), np.concatenate(faces))


def grid(points: ArrayLike) -> TriangleMesh:
    """A sheet through a grid of points.

    Args:
        points: points (rows, columns, 3); the front side is that of rows × columns directions.
    """
    p = np.asarray(points, dtype=np.float64)
    rows, columns = p.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return TriangleMesh(p.reshape(-1, 3), faces)


def _prism(rings: Iterable[tuple[Floats, float]]) -> TriangleMesh:
    """A closed body along z: walls between rising (outline (n, 2), counter-clockwise and convex; height), flat ends."""
    outlines = [np.column_stack([outline, np.full(len(outline), z)]) for outline, z in rings]
    closed = [np.vstack([ring, ring[:1]]) for ring in outlines]
    # a wall seen from outside: round the outline first, then up
    walls = [grid(np.stack([low, high], axis=1)) for low, high in pairwise(closed)]
    return merged([*walls, _fan(outlines[0][::-1]), _fan(outlines[-1])])


def _fan(ring: Floats) -> TriangleMesh:
    """A convex flat face round its middle."""
    n = len(ring)
    around = np.arange(n)
    faces = np.stack([np.full(n, n), around, (around + 1) % n], axis=1)
    return TriangleMesh(np.vstack([ring, ring.mean(axis=0)]), faces)


def link_outline(first: Circle, second: Circle, sectors: int = SECTORS) -> Floats:
    """Outline of a link seen along its joint axes: two circles and their common tangents, (sectors + 2, 2).

    Args:
        first, second: centre and radius of each circle; where one lies in the other, the larger radius
            round the first centre.
        sectors: even number of points on the two arcs together.
    """
    (a, r0), (b, r1) = first, second
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = math.hypot(dx, dy)
    if length <= abs(r0 - r1):
        r0 = r1 = max(r0, r1)
        b, length = a, 0.0
    heading = math.atan2(dy, dx) if length else 0.0
    spread = math.acos((r0 - r1) / length) if length else math.pi / 2
    near = np.linspace(heading - spread, heading + spread, sectors // 2 + 1)
    far = np.linspace(heading + spread, heading + 2 * math.pi - spread, sectors // 2 + 1)
    return np.concatenate([_arc(b, r1, near), _arc(a, r0, far)])


def _arc(centre: tuple[float, float], radius: float, angles: Floats) -> Floats:
    points: Floats = centre + radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return points


def link(first: Circle, second: Circle, span: tuple[float, float], rim: float = 0.0) -> TriangleMesh:
    """A link between two parallel joint axes along z, its rims rounded off.

    Args:
        first, second: centre (x, y) and radius of each circle, m.
        span: its two flat sides, lower first, m.
        rim: radius of the rounding, m, below both radii and half the thickness.
    """
    (a, r0), (b, r1) = first, second
    low, high = span
    steps = (0.0, 22.5, 45.0, 67.5, 90.0) if rim > 0.0 else (90.0,)
    rings = []  # outline, and how far it lies inside the flat side
    for angle in map(math.radians, steps):
        inset = rim * (1.0 - math.sin(angle))
        rings.append((link_outline((a, r0 - inset), (b, r1 - inset)), rim * (1.0 - math.cos(angle))))
    return _prism([*((ring, low + z) for ring, z in rings), *((ring, high - z) for ring, z in reversed(rings))])


def cylinder(radius: float, span: tuple[float, float], rim: float = 0.0) -> TriangleMesh:
    """A round cylinder along z; see :func:`link`."""
    return link(((0.0, 0.0), radius), ((0.0, 0.0), radius), span, rim)


def revolved(profile: ArrayLike, sectors: int = SECTORS) -> TriangleMesh:
    """A surface of revolution about z.

    Args:
        profile: rows (distance from the axis, height) (n, 2), m; the outside lies to its right.
        sectors: number of sectors round the axis.
    """
    p = np.asarray(profile, dtype=np.float64)
    angles = np.linspace(0.0, 2.0 * math.pi, sectors + 1)
    x, y = np.outer(np.cos(angles), p[:, 0]), np.outer(np.sin(angles), p[:, 0])
    return grid(np.stack([x, y, np.broadcast_to(p[:, 1], x.shape)], axis=-1))


def dome(radius: float, opening_rad: float, rings: int = 24) -> TriangleMesh:
    """The part of a sphere round its pole (+z), centre at the origin.

    Args:
        radius: radius of the sphere, m.
        opening_rad: angle from the pole to the rim; π for the whole sphere.
        rings: number of rings from the rim to the pole.
    """
    angle = np.linspace(opening_rad, 0.0, rings + 1)
    return revolved(np.column_stack([radius * np.sin(angle), radius * np.cos(angle)]))
