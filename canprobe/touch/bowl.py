"""A round hollow, and what happens when a ball is too large for it."""

from __future__ import annotations

from math import hypot, pi, sqrt

import numpy as np
import numpy.typing as npt

from canprobe.touch.placed import Array, Foot, PlacedShape, Touches, osculating_matrix, require_positive, tangent_of

LIP_M = 1e-3
"""Radius of the rounding between the hollow's wall and the top."""
_PIECES = 360


class Bowl(PlacedShape):
    """Hollow half sphere in a solid block with a rounded lip and a flat top.

    The centre is at z = +radius, the origin at the bottom; the top lies a lip's radius above the centre. A ball too
    large to go in rests on the lip all round: there ``touches`` cuts the ring into short edges.

    Args:
        T_base_object: (4, 4) pose, m.
        radius: m.
    """

    def __init__(self, T_base_object: npt.ArrayLike, radius: float) -> None:
        super().__init__(T_base_object)
        require_positive(radius=radius)
        self.radius = radius
        angles = np.arange(_PIECES) * (2.0 * pi / _PIECES)
        ring = radius + LIP_M
        self._ring = np.column_stack((ring * np.cos(angles), ring * np.sin(angles), np.full(_PIECES, radius)))

    def _foot(self, x: float, y: float, z: float) -> Foot:
        radius = self.radius
        zc = z - radius
        if zc > 0.0:
            return self._lip_foot(x, y, zc)
        k = -1.0 / radius
        rho = sqrt(x * x + y * y + zc * zc)
        nx, ny, nz = (-x / rho, -y / rho, -zc / rho) if rho > 0.0 else (0.0, 0.0, 1.0)
        return (
            -radius * nx,
            -radius * ny,
            radius * (1.0 - nz),
            nx,
            ny,
            nz,
            radius - rho,
            k,
            k,
            *tangent_of(nx, ny, nz),
        )

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

    def touches(self, point_base: npt.ArrayLike, reach: float) -> Touches | None:
        """Pieces of the lip under a ball whose centre is above it; see ``PlacedShape``."""
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
        length = np.full(len(points), 2.0 * pi * (self.radius + LIP_M) / _PIECES)
        return self._placed(points, normals, size[near] - LIP_M, kappa, length)

    def gaps(self, points_base: Array) -> Array:
        """Signed distances of (n, 3) points, (n,) m, positive outside the body."""
        p = self._to_object(points_base)
        zc, out = p[:, 2] - self.radius, np.hypot(p[:, 0], p[:, 1])
        inside = self.radius - np.hypot(out, zc)
        lip = np.hypot(out - self.radius - LIP_M, zc) - LIP_M
        above = np.where(out >= self.radius + LIP_M, zc - LIP_M, lip)
        gaps: Array = np.where(zc > 0.0, above, inside)
        return gaps

    def _matrix(self) -> Array:
        return osculating_matrix((-0.5 / self.radius,) * 3)

    def _tightest_anywhere(self) -> float:
        return self.radius
