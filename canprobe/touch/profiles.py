"""Surfaces that are straight along x: a sine sheet and a rounded edge, given by their section across."""

from __future__ import annotations

from math import atan2, cos, hypot, inf, pi, sin, sqrt

import numpy as np
import numpy.typing as npt

from canprobe.touch.placed import Array, Foot, PlacedShape, Touches, osculating_matrix, require_positive

_PER_WAVE = 48
_NEWTON = 60


class Wave(PlacedShape):
    """Sine sheet z = amplitude (cos(2 pi y / wavelength) - 1), a crest at the origin.

    Closest points: every local minimum of the distance on a grid of 48 points a wave, then Newton to 1e-12 m.

    Args:
        T_base_object: (4, 4) pose, m.
        amplitude: half of the height from trough to crest, m.
        wavelength: along y, m.
    """

    def __init__(self, T_base_object: npt.ArrayLike, amplitude: float, wavelength: float) -> None:
        super().__init__(T_base_object)
        require_positive(amplitude=amplitude, wavelength=wavelength)
        self.amplitude, self.wavelength = amplitude, wavelength
        self._k = 2.0 * pi / wavelength
        self._spacing = wavelength / _PER_WAVE

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
        for _ in range(_NEWTON):
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

    def touches(self, point_base: npt.ArrayLike, reach: float) -> Touches | None:
        """Both walls where a trough is too tight for the ball; see ``PlacedShape``."""
        x, y, z = self._to_object(np.asarray(point_base, dtype=float)[None])[0].tolist()
        near = [v for square, v in self._minima(y, z) if square < reach * reach]
        if len(near) < 2:
            return None
        feet = np.array([self._foot_at(v, x, y, z) for v in near])
        return self._placed(feet[:, :3], feet[:, 3:6], feet[:, 6], feet[:, 7:9], np.zeros(len(feet)))

    def gaps(self, points_base: Array) -> Array:
        """Distances of (n, 3) points to the tangent over or under them, (n,) m: first order near the surface."""
        _, y, z = self._to_object(points_base).T
        slope = self.amplitude * self._k * np.sin(self._k * y)
        gaps: Array = (z - self.amplitude * (np.cos(self._k * y) - 1.0)) / np.sqrt(1.0 + slope * slope)
        return gaps

    def _matrix(self) -> Array:
        return osculating_matrix((0.0, 0.5 * self.amplitude * self._k**2, 0.0))

    def _tightest_anywhere(self) -> float:
        return 1.0 / (self.amplitude * self._k**2)


class Fillet(PlacedShape):
    """Rounded edge along x: plane, cylinder, plane; the curvature jumps twice. The origin is the middle of the arc.

    Args:
        T_base_object: (4, 4) pose, m.
        radius: of the arc, m.
        angle: by which the edge turns, rad; each plane slopes down by half of it.
    """

    def __init__(self, T_base_object: npt.ArrayLike, radius: float, angle: float) -> None:
        super().__init__(T_base_object)
        require_positive(radius=radius)
        if not 0.0 < angle < pi:
            raise ValueError(f"angle must be between 0 and pi, in rad; got {angle!r}")
        self.radius, self.angle = radius, angle
        self._half, self._sin, self._cos = 0.5 * angle, sin(0.5 * angle), cos(0.5 * angle)

    def _foot(self, x: float, y: float, z: float) -> Foot:
        radius, zc = self.radius, z + self.radius
        along = atan2(y, zc)
        if abs(along) <= self._half:
            rho = hypot(y, zc)
            ny, nz = (y / rho, zc / rho) if rho > 0.0 else (0.0, 1.0)
            return x, radius * ny, radius * (nz - 1.0), 0.0, ny, nz, rho - radius, 1.0 / radius, 0.0, 0.0, nz, -ny
        ny, nz = (self._sin if y > 0.0 else -self._sin), self._cos
        distance = y * ny + zc * nz - radius
        return x, y - distance * ny, z - distance * nz, 0.0, ny, nz, distance, 0.0, 0.0, 0.0, nz, -ny

    def _matrix(self) -> Array:
        return osculating_matrix((0.0, 0.5 / self.radius, 0.0))
