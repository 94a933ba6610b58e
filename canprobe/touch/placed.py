"""A shape at a pose: what all touchable surfaces share.

Every shape has a frame of its own: the origin lies ON the surface at its reference (top-most) point, z is the outward
normal there. A scene thus places a surface by one of its points. Bodies are solid below the origin; curvature is
positive for convex. Distances are exact or by a safeguarded Newton iteration to 1e-12 m.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, sqrt
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

Foot = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""Local closest point: point xyz, outward normal xyz, signed distance, kappa1, kappa2, direction1 xyz."""
Vec = tuple[float, float, float]


class Nearest(NamedTuple):
    """What ``ClosestPoint`` holds, in plain floats for those who ask in every cycle."""

    point: Vec
    normal: Vec
    distance: float
    kappa: tuple[float, float]
    directions: tuple[Vec, Vec]


@dataclass(frozen=True, slots=True, eq=False)
class ClosestPoint:
    """The surface point nearest to a query point, in the base frame.

    Attributes:
        point: (3,) m.
        normal: (3,) outward unit normal of the body.
        distance: signed distance of the query point, m, positive outside.
        kappa: (2,) principal curvatures, 1/m, larger first, positive for convex.
        directions: (2, 3) unit rows d1, d2 with d1 x d2 = normal. They are axes: the common sign is arbitrary, and at
            an umbilic any such pair may stand.
    """

    point: Array
    normal: Array
    distance: float
    kappa: Array
    directions: Array


@dataclass(frozen=True, slots=True, eq=False)
class Touches:
    """All places where a ball touches at once, base frame.

    Attributes:
        points, normals: (n, 3) m, outward.
        distances: (n,) from the ball's centre, m.
        kappa: (n, 2) principal curvatures, 1/m, larger first.
        edge_m: (n,) length of edge that a place stands for, m; 0 for a point of a smooth surface.
    """

    points: Array
    normals: Array
    distances: Array
    kappa: Array
    edge_m: Array


class ObjectShape(Protocol):
    """What the plant, the plan and the studies ask of an object."""

    @property
    def T_base_object(self) -> Array:
        """(4, 4) frame of the object in the base frame, m."""

    def closest(self, point_base: npt.ArrayLike) -> ClosestPoint:
        """Closest surface point to a (3,) point of the base frame, m."""

    def nearest(self, point_base: Vec) -> Nearest:
        """The same in plain floats."""

    def touches(self, point_base: npt.ArrayLike, reach: float) -> Touches | None:
        """Where a ball touches if that is not its closest point alone (see ``PlacedShape``)."""

    def gaps(self, points_base: Array) -> Array:
        """Signed distances of (n, 3) points (see ``PlacedShape``)."""

    def tightest_concave_radius(self, region: npt.ArrayLike | None = None) -> float:
        """Smallest radius of a hollow, m; inf where there is none (see ``PlacedShape``)."""

    def surface_matrix(self) -> Array:
        """(4, 4) quadric of the surface in the base frame, f < 0 inside, gradient of length 1 at the origin."""


class PlacedShape:
    """A shape at a pose: carries queries into the object's frame and answers back.

    Args:
        T_base_object: (4, 4) pose of the object's frame, m.

    Raises:
        ValueError: for a pose that is not a rotation and a translation.
    """

    def __init__(self, T_base_object: npt.ArrayLike) -> None:
        pose = np.array(T_base_object, dtype=float)
        if pose.shape != (4, 4) or not np.all(np.isfinite(pose)):
            raise ValueError(f"T_base_object must be a finite 4x4 pose, got {pose!r}")
        R = pose[:3, :3]
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-9 or np.linalg.det(R) < 0.0:
            raise ValueError(f"T_base_object must hold a rotation, got {R!r}")
        pose.setflags(write=False)
        self._pose = pose
        self._rotation_t = np.ascontiguousarray(R.T)
        self._columns = tuple(R.T.ravel().tolist())
        self._origin = tuple(pose[:3, 3].tolist())

    @property
    def T_base_object(self) -> Array:
        """(4, 4) frame of the object in the base frame, m."""
        return self._pose

    def closest(self, point_base: npt.ArrayLike) -> ClosestPoint:
        """Closest surface point, its normal and curvatures.

        Args:
            point_base: (3,) query point in the base frame, m.

        Returns:
            Everything in the base frame.
        """
        bx, by, bz = np.asarray(point_base, dtype=float).tolist()
        point, normal, distance, kappa, directions = self.nearest((bx, by, bz))
        return ClosestPoint(np.array(point), np.array(normal), distance, np.array(kappa), np.array(directions))

    def nearest(self, point_base: Vec) -> Nearest:
        """As ``closest``, in plain floats.

        Args:
            point_base: query point in the base frame, m.
        """
        bx, by, bz = point_base
        ox, oy, oz = self._origin
        x0, x1, x2, y0, y1, y2, z0, z1, z2 = self._columns
        bx, by, bz = bx - ox, by - oy, bz - oz
        px, py, pz, nx, ny, nz, distance, k1, k2, dx, dy, dz = self._foot(
            bx * x0 + by * x1 + bz * x2, bx * y0 + by * y1 + bz * y2, bx * z0 + by * z1 + bz * z2
        )
        n0, n1, n2 = nx * x0 + ny * y0 + nz * z0, nx * x1 + ny * y1 + nz * z1, nx * x2 + ny * y2 + nz * z2
        d0, d1, d2 = dx * x0 + dy * y0 + dz * z0, dx * x1 + dy * y1 + dz * z1, dx * x2 + dy * y2 + dz * z2
        return Nearest(
            (
                ox + px * x0 + py * y0 + pz * z0,
                oy + px * x1 + py * y1 + pz * z1,
                oz + px * x2 + py * y2 + pz * z2,
            ),
            (n0, n1, n2),
            distance,
            (k1, k2),
            ((d0, d1, d2), (n1 * d2 - n2 * d1, n2 * d0 - n0 * d2, n0 * d1 - n1 * d0)),
        )

    def touches(self, point_base: npt.ArrayLike, reach: float) -> Touches | None:
        """Where a ball touches the surface if that is not its closest point alone.

        Args:
            point_base: (3,) centre of the ball, base frame, m.
            reach: its radius, m.

        Returns:
            Every place nearer than the reach; None where ``closest`` tells all there is.
        """
        return None

    def gaps(self, points_base: Array) -> Array:
        """Signed distances of many points, positive outside.

        Args:
            points_base: (n, 3) m.

        Returns:
            (n,) m.
        """
        return np.array([self.closest(p).distance for p in points_base])

    def _to_object(self, points_base: Array) -> Array:
        """(n, 3) points of the base frame in the object's."""
        local: Array = (points_base - self._pose[:3, 3]) @ self._pose[:3, :3]
        return local

    def _placed(self, points: Array, normals: Array, distances: Array, kappa: Array, edge_m: Array) -> Touches:
        """Touches of the object's frame in the base frame."""
        turn = self._rotation_t
        return Touches(points @ turn + self._pose[:3, 3], normals @ turn, distances, kappa, edge_m)

    def tightest_concave_radius(self, region: npt.ArrayLike | None = None) -> float:
        """Smallest radius of a hollow of the surface; a probe must be smaller to touch in one point.

        Args:
            region: (n, 3) base points; answers for their closest surface points. None: the whole surface
                (for a general quadric: the surface within 50 mm of the object's origin, sampled).

        Returns:
            Radius, m; inf where nothing is concave.
        """
        if region is None:
            return self._tightest_anywhere()
        k2 = min(float(self.closest(p).kappa[1]) for p in np.atleast_2d(np.asarray(region, dtype=float)))
        return -1.0 / k2 if k2 < -1e-12 else inf

    def surface_matrix(self) -> Array:
        """(4, 4) quadric S of the surface in the base frame: f = X'SX, X = (x, y, z, 1), f < 0 inside.

        Scaled so that the gradient has length 1 at the object's origin.
        """
        T_object_base = np.linalg.inv(self._pose)
        S: Array = T_object_base.T @ self._matrix() @ T_object_base
        return (S + S.T) / 2

    def _foot(self, x: float, y: float, z: float) -> Foot:
        raise NotImplementedError

    def _matrix(self) -> Array:
        raise NotImplementedError

    def _tightest_anywhere(self) -> float:
        return inf


def osculating_matrix(diagonal: tuple[float, float, float]) -> Array:
    """Quadric x'Dx + z = 0, through the origin with unit outward gradient along z."""
    S = np.diag((*diagonal, 0.0))
    S[2, 3] = S[3, 2] = 0.5
    return S


def require_positive(**lengths: float) -> None:
    for name, value in lengths.items():
        if not 0.0 < value < inf:
            raise ValueError(f"{name} must be a positive length in m, got {value!r}")


def tangent_of(nx: float, ny: float, nz: float) -> tuple[float, float, float]:
    """Unit tangent: the object's x axis (or z axis, where the normal is near x) freed of its normal part."""
    if abs(nx) < 0.9:
        size = sqrt(ny * ny + nz * nz)
        return size, -nx * ny / size, -nx * nz / size
    size = sqrt(nx * nx + ny * ny)
    return -nz * nx / size, -nz * ny / size, size
