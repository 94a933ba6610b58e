"""Pressure on the pad: fine sampling on the exact sphere, averaged over each taxel and blurred by the cover.

Finer than the estimators' paraboloid on purpose: the probe's height is the sphere's, taxels lie on the wrapped sphere
with their true area, and nine samples make one taxel.

Pad frame: x = u = columns, y = v = rows, z = pole of the probe, origin at the centre of the sphere. Taxel (i, j) of a
grid of m rows and n columns is centred at u = (j - (n - 1)/2) pitch, v = (i - (m - 1)/2) pitch; (u, v) lies in the
direction of the exponential map of (u, v) / R at the pole. A flat pad is a sphere of `FLAT_RADIUS_M`.
"""

from __future__ import annotations

from math import atan2, ceil, cos, floor, hypot, sin, sqrt
from typing import Any

import numpy as np

from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.types import Floats

Vec = tuple[float, float, float]
Directions = tuple[tuple[float, float], tuple[float, float]] | Floats
"""(2, 2) rows: principal directions in the basis ``pad_basis`` of the contact direction."""
_BLUR_MARGIN = 2
"""Taxels of pressure beyond the array's edge that still blur into it."""
_NO_PRESSURE = np.array(0.0)


def pad_direction(u: float, v: float, radius: float) -> Vec:
    """Unit direction of a pad point from the sphere's centre (exponential map), pad frame.

    Args:
        u: m along the pad's x.
        v: m along the pad's y.
        radius: m.
    """
    arc = hypot(u, v)
    scale = sin(arc / radius) / arc if arc > 0.0 else 1.0 / radius
    return scale * u, scale * v, cos(arc / radius)


def pad_coordinates(direction: Vec, radius: float) -> tuple[float, float]:
    """Pad point of a direction (logarithmic map), the inverse of ``pad_direction``.

    Args:
        direction: unit vector, pad frame.
        radius: m.

    Returns:
        (u, v), m.
    """
    x, y, z = direction
    side = hypot(x, y)
    scale = radius * atan2(side, z) / side if side > 0.0 else radius
    return scale * x, scale * y


def pad_basis(direction: Vec) -> tuple[Vec, Vec]:
    """Tangent vectors at a direction: the pad's x and y axes turned there the shortest way (parallel transport).

    Args:
        direction: unit vector, pad frame, not opposite the pole.

    Returns:
        Unit vectors e_u, e_v.
    """
    x, y, z = direction
    c = 1.0 / (1.0 + z)
    return (1.0 - c * x * x, -c * x * y, -x), (-c * x * y, 1.0 - c * y * y, -y)


def _averaging_matrix(taxels: int, samples: int, blur_pitch: float) -> Floats:
    """(taxels, n) weights along one axis: mean over each taxel of the blurred samples."""
    count = (taxels + 2 * _BLUR_MARGIN) * samples
    mean: Floats = np.repeat(np.eye(taxels, taxels + 2 * _BLUR_MARGIN, _BLUR_MARGIN), samples, axis=1) / samples
    if blur_pitch <= 0.0:
        return mean
    offsets = np.subtract.outer(np.arange(count), np.arange(count)) / samples
    kernel = np.exp(-0.5 * (offsets / blur_pitch) ** 2)
    reach = np.arange(-10 * samples, 10 * samples + 1) / samples
    weights: Floats = mean @ kernel / np.exp(-0.5 * (reach / blur_pitch) ** 2).sum()
    weights[weights < 1e-12] = 0.0  # products of far tails would be denormal numbers, and slow
    return weights


def _half_axis(depth: float, kappa: float, radius: float) -> float:
    """Half-axis of the patch along a principal direction, m; large where the hollow fits the probe."""
    relative = 0.5 * (1.0 / radius + kappa)
    return sqrt(depth / relative) if relative > depth else 1.0


class PressureField:
    """Mean pressure of every taxel under one contact. Listed taxels are separate rectangles, without blur.

    Args:
        radius_m: probe radius.
        pad: its taxels.
        blur_pitch: standard deviation of the cover's Gaussian blur, in taxel pitches; 0 for none.
        samples: samples per taxel and axis.
    """

    def __init__(self, radius_m: float, pad: Pad | None = None, *, blur_pitch: float = 0.65, samples: int = 3) -> None:
        pad = pad or Pad()
        self.radius, self.shape, self._step = radius_m, pad.shape, pad.pitch_m / samples
        self._rows: Floats | None = None  # of a grid; a row of samples is a listed taxel
        if pad.is_grid:
            v, u = (
                (np.arange((taxels + 2 * _BLUR_MARGIN) * samples) + 0.5) * self._step
                - (taxels / 2 + _BLUR_MARGIN) * pad.pitch_m
                for taxels in pad.shape
            )
            u, v = np.meshgrid(u, v)
            self._rows = _averaging_matrix(pad.rows, samples, blur_pitch)
            self._columns = np.ascontiguousarray(_averaging_matrix(pad.columns, samples, blur_pitch).T)
        else:
            inside = (np.arange(samples) + 0.5) / samples - 0.5
            du, dv = np.meshgrid(*(side * inside for side in pad.cell_m or (pad.pitch_m, pad.pitch_m)))
            u, v = (pad.uv[:, axis, None] + d.reshape(-1) for axis, d in ((0, du), (1, dv)))
            self._columns = np.full((samples**2, 1), 1.0 / samples**2)
        self._samples = _sample_rows(u, v, radius_m)

    def _span(self, centre: float, half: float, count: int) -> tuple[int, int]:
        """Sample indices along one axis that cover centre +- half, clipped to the grid."""
        middle = centre / self._step + 0.5 * count - 0.5
        reach = 1.08 * half / self._step + 1.0  # the flat pad stretches arcs across the pole by up to 4 %
        low, high = floor(max(middle - reach, 0.0)), ceil(min(middle + reach, count - 1.0)) + 1
        return low, high

    def points(self, centre: Floats, axes: Floats) -> Floats:
        """(n, 3) places of all samples on the undeformed probe, base frame.

        Args:
            centre: (3,) of the probe, m.
            axes: (3, 3) rows: its x, y and z axes.
        """
        return centre + self.radius * self._samples[:3].reshape(3, -1).T @ axes

    def mean_of(self, compression: Floats) -> Floats:
        """Taxel means of a compression given at all samples, as ``mean_pressure`` gives them.

        Args:
            compression: (n,) m, in the order of ``points``; negative for gaps.
        """
        area = self._samples[4]
        return self._means(np.maximum(compression, 0.0).reshape(area.shape) * area)

    def mean_pressure(
        self, uv: tuple[float, float], depth: float, kappa: tuple[float, float], directions_pad: Directions
    ) -> Floats:
        """Taxel means of ``depth - probe height - object height`` where positive.

        Args:
            uv: contact point on the pad, m.
            depth: indentation, m.
            kappa: principal curvatures of the object, 1/m, larger first.
            directions_pad: directions of the contact on the pad.

        Returns:
            (rows, columns) layer compression, m, times taxel area over pitch^2; times k it is force over pitch^2, Pa.
        """
        if depth <= 0.0:
            return np.zeros(self.shape)
        radius = self.radius
        given = directions_pad.tolist() if isinstance(directions_pad, np.ndarray) else directions_pad
        _, r1, c1 = self._samples.shape
        r0 = c0 = 0
        if self._rows is not None:
            (m11, m12), (m21, m22) = given
            a, b = _half_axis(depth, kappa[0], radius), _half_axis(depth, kappa[1], radius)
            r0, r1 = self._span(uv[1], hypot(a * m12, b * m22), r1)
            c0, c1 = self._span(uv[0], hypot(a * m11, b * m21), c1)
        if r0 >= r1 or c0 >= c1:
            return np.zeros(self.shape)
        samples = self._samples[:, r0:r1, c0:c1].reshape(5, -1)
        squeeze = _compression(samples, uv, depth, kappa, directions=given, radius=radius)
        return self._means(squeeze.reshape(r1 - r0, -1), r0, c0)

    def _means(self, part: Floats, row: int = 0, column: int = 0) -> Floats:
        """(rows, columns) taxel means of samples of which those from a row and a column on are not zero."""
        columns = self._columns[column : column + part.shape[1]]
        if self._rows is not None:
            part = self._rows[:, row : row + len(part)].dot(part)
        means: Floats = part.dot(columns).reshape(self.shape)
        return means


def _sample_rows(u: Floats, v: Floats, radius: float) -> Floats:
    """(5, …) of samples at pad points: their directions; 1; and the area of a pad cell on the sphere over du dv."""
    arc = np.hypot(u, v) / radius
    sinc = np.sinc(arc / np.pi)
    return np.stack((sinc * u / radius, sinc * v / radius, np.cos(arc), np.ones_like(arc), sinc))


def _compression(
    samples: Floats,
    uv: tuple[float, float],
    depth: float,
    kappa: tuple[float, float],
    *,
    directions: Any,
    radius: float,
) -> Floats:
    """Compression of the layer at samples (5, n), times the area of their cells.

    Depth less the probe's height above its lowest point, R (1 - s.d), which is exact, less the object's heights along
    its principal directions.
    """
    (m11, m12), (m21, m22) = directions
    d = pad_direction(uv[0], uv[1], radius)
    (x0, x1, x2), (y0, y1, y2) = pad_basis(d)
    rows = [(radius * d[0], radius * d[1], radius * d[2], depth - radius)]  # and the roots of the object's heights
    for curvature, mx, my in ((kappa[0], m11, m12), (kappa[1], m21, m22)):
        if curvature:
            root = radius * sqrt(0.5 * abs(curvature))
            a, b = root * mx, root * my
            rows.append((a * x0 + b * y0, a * x1 + b * y1, a * x2 + b * y2, 0.0))
    squeeze: Floats
    squeeze, *across = np.array(rows).dot(samples[:4])
    for curvature, height in zip(filter(None, kappa), across, strict=True):
        np.square(height, out=height)
        if curvature > 0.0:
            squeeze -= height
        else:
            squeeze += height
    np.maximum(squeeze, _NO_PRESSURE, out=squeeze)
    squeeze *= samples[4]
    return squeeze
