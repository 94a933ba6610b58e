"""The base class of all touchable surfaces, a shape at a pose, and some shapes: bowl, wave, cylinder, fillet, torus.

Every shape has a frame: its origin lies ON the surface at the reference (top-most) point, and z is the outward normal
there. A scene thus places a surface by one of its points. Bodies are solid below the origin; curvature is positive for
convex. Distances are exact or by a safeguarded Newton iteration to 1e-12 m.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, hypot, inf, pi, sin, sqrt
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from canprobe.mechanics.types import Floats, Vec

Foot = tuple[float, float, float, float, float, float, float, float, float, float, float, float]
"""Local closest point: point xyz, outward normal xyz, signed distance, kappa1, kappa2, direction1 xyz."""


class Nearest(NamedTuple):
    """As `ClosestPoint`, in plain floats, for callers in every cycle."""

    point: Vec
    normal: Vec
    distance: float
    kappa: tuple[float, float]
    directions: tuple[Vec, Vec]


@dataclass(frozen=True, slots=True, eq=False)
class ClosestPoint:
    """The surface point nearest to a query point, in the base frame.

    Attributes:
        point: (3,) closest point, m.
        normal: (3,) outward unit normal of the body there.
        distance: signed distance of the query point, m, positive outside.
        kappa: (2,) principal curvatures, 1/m, larger first, positive for convex.
        directions: (2, 3) unit rows d1, d2 with d1 x d2 = normal. They are axes: the common sign is arbitrary, and at
            an umbilic any such pair may stand.
    """

    point: Floats
    normal: Floats
    distance: float
    kappa: Floats
    directions: Floats


@dataclass(frozen=True, slots=True, eq=False)
class TouchedPlaces:
    """All places where a ball touches at once, base frame.

    Attributes:
        points, normals: (n, 3) points, m, and outward unit normals.
        distances: (n,) distances from the ball's centre, m.
        kappa: (n, 2) principal curvatures, 1/m, larger first.
        edge_m: (n,) length of edge that a place stands for, m; 0 for a point of a smooth surface.
    """

    points: Floats
    normals: Floats
    distances: Floats
    kappa: Floats
    edge_m: Floats


class PlacedShape:
    """A shape at a pose: carries queries into the object's frame and answers back.

    Args:
        T_base_object: (4, 4) pose of the object's frame, m.

    Raises:
        ValueError: the pose is not a rotation and a translation.
    """

    by_gaps = False
    """Whether force and pressure follow from the gaps all over a ball, and not from the curvature at the contact."""

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
    def T_base_object(self) -> Floats:
        """(4, 4) frame of the object in the base frame, m."""
        return self._pose

    def closest(self, point_base: npt.ArrayLike) -> ClosestPoint:
        """Closest surface point to a (3,) point of the base frame (m), its normal and curvatures."""
        bx, by, bz = np.asarray(point_base, dtype=float).tolist()
        point, normal, distance, kappa, directions = self.nearest((bx, by, bz))
        return ClosestPoint(np.array(point), np.array(normal), distance, np.array(kappa), np.array(directions))

    def nearest(self, point_base: Vec) -> Nearest:
        """As ``closest``, in plain floats."""
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

    def touches(self, point_base: npt.ArrayLike, reach: float) -> TouchedPlaces | None:
        """Every place where a ball (centre (3,) in base, radius, m) touches; None where ``closest`` is all there is."""
        return None

    def gaps(self, points_base: Floats) -> Floats:
        """Signed distances (n,) of points (n, 3) of the base frame, m, positive outside."""
        return np.array([self.closest(p).distance for p in points_base])

    def squeezed(self, centre_base: Vec, radius: float) -> float:
        """Volume (m³) by which the layer of a ball is squeezed; only surfaces with `by_gaps` have it."""
        raise NotImplementedError

    def _to_object(self, points_base: Floats) -> Floats:
        """(n, 3) points of the base frame in the object's."""
        local: Floats = (points_base - self._pose[:3, 3]) @ self._pose[:3, :3]
        return local

    def _placed(
        self, points: Floats, normals: Floats, distances: Floats, kappa: Floats, edge_m: Floats
    ) -> TouchedPlaces:
        """Places in the object's frame, carried to the base frame."""
        turn = self._rotation_t
        return TouchedPlaces(points @ turn + self._pose[:3, 3], normals @ turn, distances, kappa, edge_m)

    def _several(self, feet: list[Foot]) -> TouchedPlaces | None:
        """Feet on a smooth surface as places, where there are several."""
        at = np.array(feet)
        return None if len(at) < 2 else self._placed(at[:, :3], at[:, 3:6], at[:, 6], at[:, 7:9], np.zeros(len(at)))

    def tightest_concave_radius(self, region: npt.ArrayLike | None = None) -> float:
        """Smallest radius of a hollow of the surface; a probe must be smaller to touch in one point.

        Args:
            region: (n, 3) base points; answers for their closest surface points. None: the whole surface
                (for a general quadric: the surface within 50 mm of the object's origin, sampled; for heights: the
                origin).

        Returns:
            Radius, m; inf where nothing is concave.
        """
        if region is None:
            return self._tightest_anywhere()
        k2 = min(float(self.closest(p).kappa[1]) for p in np.atleast_2d(np.asarray(region, dtype=float)))
        return -1.0 / k2 if k2 < -1e-12 else inf

    def _foot(self, x: float, y: float, z: float) -> Foot:
        raise NotImplementedError

    def _tightest_anywhere(self) -> float:
        return inf


def require_positive(**lengths: float) -> None:
    """Refuse lengths that are not above 0 m and finite."""
    for name, value in lengths.items():
        if not 0.0 < value < inf:
            raise ValueError(f"{name} must be a positive length in m, got {value!r}")


class RoundShape(PlacedShape):
    """A shape with a radius.

    Args:
        T_base_object: (4, 4) pose, m.
        radius: radius, m.
    """

    def __init__(self, T_base_object: npt.ArrayLike, radius: float) -> None:
        super().__init__(T_base_object)
        require_positive(radius=radius)
        self.radius = radius


def tangent_of(nx: float, ny: float, nz: float) -> tuple[float, float, float]:
    """Unit tangent: the object's x axis (or z axis, where the normal is near x) freed of its normal part."""
    if abs(nx) < 0.9:
        size = sqrt(ny * ny + nz * nz)
        return size, -nx * ny / size, -nx * nz / size
    size = sqrt(nx * nx + ny * ny)
    return -nz * nx / size, -nz * ny / size, size


LIP_M = 1e-3
"""Radius of the rounding between the hollow's wall and the top, m."""
_LIP_PIECES = 360
"""Number of short edges into which the ring of contact on a lip is cut."""


class Bowl(RoundShape):
    """Hollow half sphere in a solid block with a rounded lip and a flat top.

    The centre is at z = +radius, the origin at the bottom; the top lies a lip's radius above the centre. A ball too
    large to go in rests on the lip all round: there ``touches`` cuts the ring into short edges.
    """

    def __init__(self, T_base_object: npt.ArrayLike, radius: float) -> None:
        super().__init__(T_base_object, radius)
        angles = np.arange(_LIP_PIECES) * (2.0 * pi / _LIP_PIECES)
        ring = radius + LIP_M
        self._ring = np.column_stack((ring * np.cos(angles), ring * np.sin(angles), np.full(_LIP_PIECES, radius)))

    def _foot(self, x: float, y: float, z: float) -> Foot:
        radius = self.radius
        zc = z - radius
        if zc > 0.0:
            return self._lip_foot(x, y, zc)
        k = -1.0 / radius
        rho = sqrt(x * x + y * y + zc * zc)
        nx, ny, nz = (-x / rho, -y / rho, -zc / rho) if rho > 0.0 else (0.0, 0.0, 1.0)
        foot = -radius * nx, -radius * ny, radius * (1.0 - nz)
        return (*foot, nx, ny, nz, radius - rho, k, k, *tangent_of(nx, ny, nz))

    def _lip_foot(self, x: float, y: float, zc: float) -> Foot:
        """Closest point of the lip or the top; zc is counted from the centre's height."""
        ring = self.radius + LIP_M
        out = hypot(x, y)
        if out >= ring:
            return x, y, self.radius + LIP_M, 0.0, 0.0, 1.0, zc - LIP_M, 0.0, 0.0, 1.0, 0.0, 0.0
        ex, ey = (x / out, y / out) if out > 0.0 else (1.0, 0.0)
        side = out - ring
        size = sqrt(side * side + zc * zc)
        nr, nz = side / size, zc / size
        rim = ring + LIP_M * nr
        return (
            *(rim * ex, rim * ey, self.radius + LIP_M * nz, nr * ex, nr * ey, nz),
            *(size - LIP_M, 1.0 / LIP_M, nr / rim, -nz * ex, -nz * ey, nr),
        )

    def touches(self, point_base: npt.ArrayLike, reach: float) -> TouchedPlaces | None:
        """Pieces of the lip under a ball whose centre is above it."""
        p = self._to_object(np.asarray(point_base, dtype=float)[None])[0]
        if p[2] <= self.radius or hypot(p[0], p[1]) >= self.radius + LIP_M:
            return None
        towards = p - self._ring
        size = np.sqrt(np.sum(towards * towards, axis=1))
        near = size - LIP_M < reach
        normals = towards[near] / size[near, None]
        points = self._ring[near] + LIP_M * normals
        across = np.sum(normals[:, :2] * points[:, :2], axis=1)
        kappa = np.column_stack((np.full(len(points), 1.0 / LIP_M), across / np.sum(points[:, :2] ** 2, axis=1)))
        length = np.full(len(points), 2.0 * pi * (self.radius + LIP_M) / _LIP_PIECES)
        return self._placed(points, normals, size[near] - LIP_M, kappa, length)

    def gaps(self, points_base: Floats) -> Floats:
        """Signed distances of (n, 3) points, (n,) m, positive outside the body."""
        p = self._to_object(points_base)
        zc, out = p[:, 2] - self.radius, np.hypot(p[:, 0], p[:, 1])
        inside = self.radius - np.hypot(out, zc)
        lip = np.hypot(out - self.radius - LIP_M, zc) - LIP_M
        above = np.where(out >= self.radius + LIP_M, zc - LIP_M, lip)
        return np.where(zc > 0.0, above, inside)

    def _tightest_anywhere(self) -> float:
        return self.radius


_POINTS_PER_WAVE = 48
"""Points of the grid on which a wave's minima are looked for, per wavelength."""
_MAX_NEWTON_STEPS = 60


class Wave(PlacedShape):
    """Sine sheet z = amplitude (cos(2 pi y / wavelength) - 1), a crest at the origin.

    Closest points: every local minimum of the distance on a grid of 48 points a wave, then Newton to 1e-12 m.

    Args:
        T_base_object: (4, 4) pose, m.
        amplitude: half of the height from trough to crest, m.
        wavelength: length of a wave along y, m.
    """

    def __init__(self, T_base_object: npt.ArrayLike, amplitude: float, wavelength: float) -> None:
        super().__init__(T_base_object)
        require_positive(amplitude=amplitude, wavelength=wavelength)
        self.amplitude, self.wavelength = amplitude, wavelength
        self._k = 2.0 * pi / wavelength
        self._spacing = wavelength / _POINTS_PER_WAVE

    def _height(self, y: float) -> tuple[float, float, float]:
        """z, dz/dy and d2z/dy2."""
        a, k = self.amplitude, self._k
        c, s = cos(k * y), sin(k * y)
        return a * (c - 1.0), -a * k * s, -a * k * k * c

    def _minima(self, y: float, z: float) -> list[tuple[float, float]]:
        """(distance squared, y) of the section's local minima that may be the nearest, nearest first."""
        reach = abs(z - self._height(y)[0]) + self._spacing
        count = int(reach / self._spacing) + 2
        grid = y + self._spacing * np.arange(-count, count + 1)
        square = (grid - y) ** 2 + (self.amplitude * (np.cos(self._k * grid) - 1.0) - z) ** 2
        low = np.flatnonzero((square[1:-1] <= square[:-2]) & (square[1:-1] < square[2:])) + 1
        feet = [self._polished(float(grid[i]), y, z) for i in low]
        return sorted(((v - y) ** 2 + (self._height(v)[0] - z) ** 2, v) for v in feet)

    def _polished(self, start: float, y: float, z: float) -> float:
        """Root of half the squared distance's slope within a grid step of the start."""
        low, high, v = start - self._spacing, start + self._spacing, start
        for _ in range(_MAX_NEWTON_STEPS):
            h, slope, bend = self._height(v)
            g = v - y + (h - z) * slope
            low, high = (v, high) if g < 0.0 else (low, v)
            rise = 1.0 + slope * slope + (h - z) * bend
            new = v - g / rise if rise > 0.0 else inf
            if not low <= new <= high:
                new = 0.5 * (low + high)
            if abs(new - v) < 1e-15:
                break
            v = new
        return v

    def _foot(self, x: float, y: float, z: float) -> Foot:
        return self._foot_at(self._minima(y, z)[0][1], x, y, z)

    def _foot_at(self, v: float, x: float, y: float, z: float) -> Foot:
        h, slope, bend = self._height(v)
        size = sqrt(1.0 + slope * slope)
        ny, nz = -slope / size, 1.0 / size
        across = -bend / size**3
        distance = (y - v) * ny + (z - h) * nz
        if across >= 0.0:
            return x, v, h, 0.0, ny, nz, distance, across, 0.0, 0.0, nz, -ny
        return x, v, h, 0.0, ny, nz, distance, 0.0, across, 1.0, 0.0, 0.0

    def touches(self, point_base: npt.ArrayLike, reach: float) -> TouchedPlaces | None:
        """Both walls where a trough is too tight for the ball."""
        x, y, z = self._to_object(np.asarray(point_base, dtype=float)[None])[0].tolist()
        return self._several([self._foot_at(v, x, y, z) for square, v in self._minima(y, z) if square < reach * reach])

    def gaps(self, points_base: Floats) -> Floats:
        """Distances of (n, 3) points to the tangent over or under them, (n,) m: first order near the surface."""
        _, y, z = self._to_object(points_base).T
        slope = self.amplitude * self._k * np.sin(self._k * y)
        gaps: Floats = (z - self.amplitude * (np.cos(self._k * y) - 1.0)) / np.sqrt(1.0 + slope * slope)
        return gaps

    def _tightest_anywhere(self) -> float:
        return 1.0 / (self.amplitude * self._k**2)


class Cylinder(RoundShape):
    """Endless round cylinder along the object's x axis, centre line at z = -radius."""

    def _foot(self, x: float, y: float, z: float) -> Foot:
        return _arc_foot(self.radius, x, y, z)


def _arc_foot(radius: float, x: float, y: float, z: float) -> Foot:
    """The foot on a cylinder along x."""
    zc = z + radius
    rho = hypot(y, zc)
    ny, nz = (y / rho, zc / rho) if rho > 0.0 else (0.0, 1.0)
    # Round the circumference first: d1 = (0, nz, -ny), d2 = n x d1 = -x.
    return x, radius * ny, radius * (nz - 1.0), 0.0, ny, nz, rho - radius, 1.0 / radius, 0.0, 0.0, nz, -ny


class Fillet(RoundShape):
    """Rounded edge along x: plane, cylinder, plane; the curvature jumps twice. The origin is the middle of the arc.

    Args:
        T_base_object: (4, 4) pose, m.
        radius: radius of the arc, m.
        angle: angle by which the edge turns, rad; each plane slopes down by half of it.
    """

    def __init__(self, T_base_object: npt.ArrayLike, radius: float, angle: float) -> None:
        super().__init__(T_base_object, radius)
        if not 0.0 < angle < pi:
            raise ValueError(f"angle must be between 0 and pi, in rad; got {angle!r}")
        self.angle = angle
        self._half, self._sin, self._cos = 0.5 * angle, sin(0.5 * angle), cos(0.5 * angle)

    def _foot(self, x: float, y: float, z: float) -> Foot:
        radius, zc = self.radius, z + self.radius
        if abs(atan2(y, zc)) <= self._half:
            return _arc_foot(radius, x, y, z)
        ny, nz = (self._sin if y > 0.0 else -self._sin), self._cos
        distance = y * ny + zc * nz - radius
        return x, y - distance * ny, z - distance * nz, 0.0, ny, nz, distance, 0.0, 0.0, 0.0, nz, -ny


class Torus(RoundShape):
    """Ring lying flat: axis along z through x = -ring_radius, the origin on its crown, x outward from the axis.

    Round the tube the curvature is 1/radius everywhere; along the ring it is positive outside, 0 on the crown and
    negative inside, where the hollow is ring_radius - radius wide.

    Args:
        T_base_object: (4, 4) pose, m.
        ring_radius: radius of the tube's centre line, m.
        radius: radius of the tube, m, smaller than `ring_radius`.
    """

    def __init__(self, T_base_object: npt.ArrayLike, ring_radius: float, radius: float) -> None:
        super().__init__(T_base_object, radius)
        if not radius < ring_radius < inf:
            raise ValueError(f"a torus needs ring_radius > radius, in m; got {ring_radius!r} and {radius!r}")
        self.ring_radius = ring_radius

    def _foot(self, x: float, y: float, z: float) -> Foot:
        ring, radius = self.ring_radius, self.radius
        out, zc = hypot(x + ring, y), z + radius
        ux, uy = ((x + ring) / out, y / out) if out > 0.0 else (1.0, 0.0)
        side = out - ring
        rho = sqrt(side * side + zc * zc)
        nr, nz = (side / rho, zc / rho) if rho > 0.0 else (0.0, 1.0)
        nx, ny = nr * ux, nr * uy
        return (
            *(ring * ux + radius * nx - ring, ring * uy + radius * ny, radius * (nz - 1.0)),
            *(nx, ny, nz, rho - radius, 1.0 / radius, nr / (ring + radius * nr), -nz * ux, -nz * uy, nr),
        )

    def _tightest_anywhere(self) -> float:
        return self.ring_radius - self.radius
