"""A surface without a formula: heights over a grid, as one C² bicubic spline.

Closest point, normal, curvature, gaps and force all come from that spline. A spline through heights at a spacing d is
true for features of several d: a sharp edge becomes a rounded one, with a radius of about d. Only the surface as seen
from +z is there; undercuts are not.

The closest point is the best of all local minima over the spline's nodes, each refined by Newton's method. No answer
depends on earlier queries: the window that is kept from one query to the next holds every node that can matter.

Source: de Boor, A Practical Guide to Splines (cubic B-splines on equal knots, not-a-knot ends).
"""

from __future__ import annotations

from math import atan2, ceil, cos, hypot, inf, sin, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from canprobe.mechanics.touch.shapes import Foot, PlacedShape, TouchedPlaces, require_positive
from canprobe.mechanics.types import Floats, Vec

MIN_NODES = 8
"""Least number of heights along each side of a grid."""
MAX_SPACING_M, MAX_RISE_M = 5e-4, 4e-6
"""Widest spacing of the nodes over which minima are searched and pressure is summed, and the distance by which a node
may be farther than the foot beside it. Sharp edges do not make the spacing finer than half of the grid's."""
MAX_BALL_RADIUS_M = 0.03
"""Largest radius of a ball for which the spacing of the nodes is chosen, m."""
_WINDOW_MARGIN_M = 1.5e-4
"""Distance of a query from that of the kept window, m, for which the window is made larger than it need be."""
_MAX_INDENTATION_M = 3e-4
"""Largest indentation of a ball for which the window holds all pressed nodes, m."""
_BLOCK_NODES = 4
_MAX_RISE_BETWEEN_NODES_M = 5e-5
"""Most by which the surface rises between its nodes, m; an upper bound."""
_MAX_NEWTON_STEPS = 40
_LAST_STEP_M = 1e-8
"""Largest last Newton step: the remaining error, its square over a radius of curvature, is below 1e-12 m."""
_SAME_PLACE_M = 1e-6
_NO_HEIGHT_M = -1e3
_BORDER_SPACINGS = 1e-6
"""Distance, in spacings, by which a place on a border of cells is moved to look up the cells on both sides."""

_Bends = tuple[float, float, float, float, float, float]
_Place = tuple[float, float, float, _Bends]
"""Squared distance of a point from a place of the surface, x and y of that place, and the spline there."""


class Spline:
    """C² bicubic spline through heights on a grid of equal spacing.

    Args:
        heights: (m, n) heights, m; x rises with the row's index, y with the column's.
        spacing: spacing along both, m.
        corner: (2,) x and y of the first height, m.
    """

    def __init__(self, heights: Floats, spacing: float, corner: tuple[float, float]) -> None:
        self.shape, self.spacing, self.corner = heights.shape, spacing, corner
        coefficients = _coefficients(_coefficients(heights).T).T
        self._flat = np.ascontiguousarray(coefficients).ravel()
        self._rows: list[list[float]] = coefficients.tolist()
        self.far = tuple(c + (n - 1) * spacing for c, n in zip(corner, heights.shape, strict=True))

    def at(self, x: float, y: float) -> _Bends:
        """Height, its slopes along x and y, and its second derivatives xx, xy, yy at a point of the grid's area."""
        scale, (m, n) = 1.0 / self.spacing, self.shape
        s, t = (x - self.corner[0]) * scale, (y - self.corner[1]) * scale
        i, j = min(max(int(s), 0), m - 2), min(max(int(t), 0), n - 2)
        s, t = s - i, t - j
        (b0, b1, b2, b3), (d0, d1, d2, d3), (e0, e1, e2, e3) = b_splines(t)
        z = zx = zy = zxx = zxy = zyy = 0.0
        for row, b, d, e in zip(self._rows[i : i + 4], *b_splines(s), strict=True):
            c0, c1, c2, c3 = row[j : j + 4]
            value, slope = b0 * c0 + b1 * c1 + b2 * c2 + b3 * c3, d0 * c0 + d1 * c1 + d2 * c2 + d3 * c3
            z += b * value
            zx += d * value
            zxx += e * value
            zy += b * slope
            zxy += d * slope
            zyy += b * (e0 * c0 + e1 * c1 + e2 * c2 + e3 * c3)
        square = scale * scale
        return z, zx * scale, zy * scale, zxx * square, zxy * square, zyy * square

    def many(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Heights and slopes along x and y of points, each (k,), of the grid's area."""
        m, n = self.shape
        s, t = (x - self.corner[0]) / self.spacing, (y - self.corner[1]) / self.spacing
        i, j = np.clip(s.astype(np.intp), 0, m - 2), np.clip(t.astype(np.intp), 0, n - 2)
        (b, d, _), (bt, dt, _) = b_splines(s - i), b_splines(t - j)
        first = i * (n + 2) + j
        z, zx, zy = np.zeros((3, len(s)))
        for k in range(4):
            rows = [self._flat.take(first + (k * (n + 2) + q)) for q in range(4)]
            value = rows[0] * bt[0] + rows[1] * bt[1] + rows[2] * bt[2] + rows[3] * bt[3]
            z += b[k] * value
            zx += d[k] * value
            zy += b[k] * (rows[0] * dt[0] + rows[1] * dt[1] + rows[2] * dt[2] + rows[3] * dt[3])
        return z, zx / self.spacing, zy / self.spacing


def b_splines(t: Any) -> tuple[tuple[Any, Any, Any, Any], ...]:
    """The four cubic B-splines over a cell at t in 0 … 1, their slopes and second derivatives, in the form of t."""
    p = 1.0 - t
    return (
        (p * p * p / 6.0, 2.0 / 3.0 - t * t * (1.0 - 0.5 * t), 2.0 / 3.0 - p * p * (1.0 - 0.5 * p), t * t * t / 6.0),
        (-0.5 * p * p, t * (1.5 * t - 2.0), p * (2.0 - 1.5 * p), 0.5 * t * t),
        (p, 3.0 * t - 2.0, 3.0 * p - 2.0, t),
    )


def _coefficients(f: Floats) -> Floats:
    """(n + 2, …) B-spline coefficients of the cubic spline through (n, …) values, along the first axis."""
    from scipy.linalg import solve_banded  # only where there are heights

    bands = np.zeros((9, len(f) + 2))
    bands[3, 2:], bands[4, 1:-1], bands[5, :-2] = 1.0, 4.0, 1.0  # c[i-1] + 4 c[i] + c[i+1] = 6 f[i]
    for k, jump in enumerate((1.0, -4.0, 6.0, -4.0, 1.0)):  # none in the third derivative: not-a-knot ends
        bands[4 - k, k] = bands[4 + k, -1 - k] = jump
    found: Floats = solve_banded((4, 4), bands, np.pad(6.0 * f, ((1, 1), (0, 0))))
    return found


class Heights(PlacedShape):
    """Surface over a grid of heights, solid below, that ends at the grid's border. Heights are along z of its frame.

    A ball may bridge a groove or stand on an edge, so the pressure on it follows from the gaps all over the pad and not
    from one curvature (`by_gaps`).

    Args:
        T_base_object: (4, 4) pose, m.
        heights: (m, n) heights, m, 8 or more along each side; x rises with the first index, y with the second.
        spacing: spacing of the grid, m.
        origin: (2,) point of the grid that becomes the object's origin, from the grid's middle, m; the surface there
            gets the height 0.
        there: (m, n) whether the surface exists at a node; a place between nodes has a surface where all four nodes
            round it have one. None: the surface is everywhere.

    Raises:
        ValueError: the heights are not a finite grid, or the origin lies beside the surface.
    """

    by_gaps = True

    def __init__(
        self,
        T_base_object: npt.ArrayLike,
        heights: npt.ArrayLike,
        spacing: float,
        origin: npt.ArrayLike = (0.0, 0.0),
        there: npt.NDArray[np.bool_] | None = None,
    ) -> None:
        super().__init__(T_base_object)
        require_positive(spacing=spacing)
        z = np.array(heights, dtype=float)
        if z.ndim != 2 or min(z.shape) < MIN_NODES:
            raise ValueError(f"heights must be a grid of {MIN_NODES} × {MIN_NODES} or more, got shape {z.shape}")
        if not np.isfinite(z).all():
            i, j = np.argwhere(~np.isfinite(z))[0].tolist()
            raise ValueError(f"heights must be finite, got {z[i, j]} at row {i}, column {j}: fill gaps first")
        ox, oy = np.array(origin, dtype=float).tolist()
        corner = -0.5 * (z.shape[0] - 1) * spacing - ox, -0.5 * (z.shape[1] - 1) * spacing - oy
        i, j = (round(-c / spacing) for c in corner)
        if not (0 <= i < z.shape[0] and 0 <= j < z.shape[1] and (there is None or there[i, j])):
            raise ValueError(f"origin ({ox:g}, {oy:g}) m lies beside the surface")
        spline = Spline(z, spacing, corner)
        z -= spline.at(0.0, 0.0)[0]
        self.spline = Spline(z, spacing, corner)
        self._fill_nodes(z, there)

    def _fill_nodes(self, heights: Floats, there: npt.NDArray[np.bool_] | None) -> None:
        """Nodes of the search: positions, heights and slopes."""
        spline = self.spline
        bend = max(float(np.abs(np.diff(heights, 2, axis=axis)).max()) for axis in (0, 1)) / spline.spacing**2
        widest = min(
            max(sqrt(4.0 * MAX_RISE_M / (bend + 1.0 / MAX_BALL_RADIUS_M)), 0.5 * spline.spacing), MAX_SPACING_M
        )
        self._x, self._y = (
            np.linspace(low, high, ceil((high - low) / widest - 1e-6) + 1)
            for low, high in zip(spline.corner, spline.far, strict=True)
        )
        self._cell = float(self._x[1] - self._x[0]), float(self._y[1] - self._y[0])
        self._step = max(self._cell)
        shape = len(self._x), len(self._y)
        x, y = (one.ravel() for one in np.meshgrid(self._x, self._y, indexing="ij"))
        self._z, self._zx, self._zy = (one.reshape(shape) for one in spline.many(x, y))
        self._cells: npt.NDArray[np.bool_] | None = None
        if there is not None and not there.all():
            self._cells = there[:-1, :-1] & there[1:, :-1] & there[:-1, 1:] & there[1:, 1:]
            self._z[~self.exists(x, y).reshape(shape)] = _NO_HEIGHT_M
        starts = [np.arange(0, n, _BLOCK_NODES) for n in shape]
        self._tops = np.maximum.reduceat(np.maximum.reduceat(self._z, starts[0], axis=0), starts[1], axis=1)
        lids = np.pad(self._tops, 1, mode="edge") + _MAX_RISE_BETWEEN_NODES_M
        lids = np.maximum(np.maximum(lids[:-2], lids[1:-1]), lids[2:])
        self._lids = np.maximum(np.maximum(lids[:, :-2], lids[:, 1:-1]), lids[:, 2:])
        self._boxes = [
            (at[start], at[np.minimum(start + _BLOCK_NODES, len(at)) - 1])
            for at, start in zip((self._x, self._y), starts, strict=True)
        ]
        self._kept: tuple[Vec, float, float, tuple[slice, slice]] | None = None

    def _window(self, x: float, y: float, z: float, reach: float) -> tuple[slice, slice]:
        """The nodes that hold all within `reach` of a point, and its nearest with all that compete with it."""
        kept = self._kept
        if kept is not None:
            (kx, ky, kz), nearest, widest, window = kept
            moved = sqrt((x - kx) ** 2 + (y - ky) ** 2 + (z - kz) ** 2)
            if nearest + 2.0 * moved + 0.5 * self._step <= widest and reach + moved <= widest:
                return window
        # No node of a block is nearer than the box that holds it; the nodes of the nearest box bound the nearest.
        dx, dy = (at - np.clip(at, low, high) for at, (low, high) in zip((x, y), self._boxes, strict=True))
        boxes = np.maximum(z - self._tops, 0.0) ** 2 + (dx * dx)[:, None] + dy * dy
        i, j = (_BLOCK_NODES * int(k) for k in divmod(int(boxes.argmin()), boxes.shape[1]))
        block = slice(i, i + _BLOCK_NODES), slice(j, j + _BLOCK_NODES)
        squares = (self._z[block] - z) ** 2 + ((self._x[block[0]] - x) ** 2)[:, None] + (self._y[block[1]] - y) ** 2
        nearest = sqrt(float(squares.min()))
        widest = max(nearest + _MAX_INDENTATION_M, reach) + 2.0 * _WINDOW_MARGIN_M + 0.5 * self._step
        inside = boxes <= widest * widest
        rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
        first, last = (slice(_BLOCK_NODES * int(k[0]), _BLOCK_NODES * int(k[-1] + 1)) for k in (rows, columns))
        window = first, last
        self._kept = (x, y, z), nearest, widest, window
        return window

    def _minima(self, x: float, y: float, z: float, reach: float | None) -> list[_Place]:
        """Feet, nearest first: all within `reach`, or those that compete for the nearest."""
        rows, columns = self._window(x, y, z, reach or 0.0)
        heights = self._z[rows, columns]
        width = heights.shape[1] + 2
        padded = np.full((len(heights) + 2, width), inf)
        square = padded[1:-1, 1:-1]
        np.subtract(heights, z, out=square)
        square *= square
        square += ((self._x[rows] - x) ** 2)[:, None] + (self._y[columns] - y) ** 2
        flat = padded.ravel()
        lowest = sqrt(float(flat.min()))
        near = np.flatnonzero(flat <= ((lowest if reach is None else max(reach, lowest)) + 0.25 * self._step) ** 2)
        value = flat[near]
        low = (value <= flat[near - width]) & (value < flat[near + width])
        low &= (value <= flat[near - 1]) & (value < flat[near + 1])
        feet: list[_Place] = []
        for index in near[low].tolist():
            i, j = divmod(index, width)
            place = self._polished(float(self._x[rows.start + i - 1]), float(self._y[columns.start + j - 1]), x, y, z)
            if all(abs(place[1] - a) + abs(place[2] - b) > _SAME_PLACE_M for _, a, b, _ in feet):
                feet.append(place)
        return feet if len(feet) == 1 else sorted(feet)

    def _polished(self, u: float, v: float, x: float, y: float, z: float) -> _Place:
        """The stationary point of the distance near (u, v), by Newton steps of at most a node's spacing."""
        at, most, node = self.spline.at, self._step, (u, v)
        (u0, v0), (u1, v1) = self.spline.corner, self.spline.far
        for _ in range(_MAX_NEWTON_STEPS):
            h, hx, hy, hxx, hxy, hyy = at(u, v)
            up = h - z
            gx, gy = u - x + up * hx, v - y + up * hy
            a, b, c = 1.0 + hx * hx + up * hxx, hx * hy + up * hxy, 1.0 + hy * hy + up * hyy
            det = a * c - b * b
            if det <= 0.0 or a <= 0.0:  # no minimum here: descend without the bend of the surface
                a, b, c = 1.0 + hx * hx, hx * hy, 1.0 + hy * hy
                det = a * c - b * b
            du, dv = (b * gy - c * gx) / det, (b * gx - a * gy) / det
            size = hypot(du, dv)
            if size > most:
                du, dv = du * most / size, dv * most / size
            new_u, new_v = min(max(u + du, u0), u1), min(max(v + dv, v0), v1)
            moved = abs(new_u - u) + abs(new_v - v)
            u, v = new_u, new_v
            if moved < _LAST_STEP_M:
                break
        if self._cells is not None:
            i, j = int((u - u0) / self.spline.spacing), int((v - v0) / self.spline.spacing)
            within = self._cells[min(i, self._cells.shape[0] - 1), min(j, self._cells.shape[1] - 1)]
            if not within and not self.exists(np.array((u,)), np.array((v,)))[0]:
                u, v = node  # beyond the surface: its nearest node is on the border
        here = at(u, v)
        return (u - x) ** 2 + (v - y) ** 2 + (here[0] - z) ** 2, u, v, here

    def _foot(self, x: float, y: float, z: float) -> Foot:
        return self._foot_at(self._minima(x, y, z, None)[0], x, y, z)

    def _foot_at(self, place: _Place, x: float, y: float, z: float) -> Foot:
        _, u, v, (h, hx, hy, hxx, hxy, hyy) = place
        square = 1.0 + hx * hx
        a, w = sqrt(square), sqrt(square + hy * hy)
        nx, ny, nz = -hx / w, -hy / w, 1.0 / w
        # Tangents t = (1, 0, hx) / a and s = n × t, and the surface's bend along them.
        sx, sy, sz = -hx * hy / (w * a), square / (w * a), hy / (w * a)
        k_tt = -hxx / (square * w)
        k_ts = -(hxx * sx + hxy * sy) / (a * w)
        k_ss = -(hxx * sx * sx + 2.0 * hxy * sx * sy + hyy * sy * sy) / w
        mean, spread = 0.5 * (k_tt + k_ss), hypot(0.5 * (k_tt - k_ss), k_ts)
        angle = 0.5 * atan2(2.0 * k_ts, k_tt - k_ss)
        along, across = cos(angle) / a, sin(angle)
        dx, dy, dz = x - u, y - v, z - h
        distance = sqrt(dx * dx + dy * dy + dz * dz)  # beyond the border the foot is not under the point
        if dx * nx + dy * ny + dz * nz < 0.0:
            distance = -distance
        return (
            *(u, v, h, nx, ny, nz, distance, mean + spread, mean - spread),
            *(along + across * sx, across * sy, along * hx + across * sz),
        )

    def _tightest_anywhere(self) -> float:
        """The hollow at the origin: elsewhere a ball bridges a tighter one."""
        tightest = self._foot_at((0.0, 0.0, 0.0, self.spline.at(0.0, 0.0)), 0.0, 0.0, 0.0)[8]
        return -1.0 / tightest if tightest < -1e-12 else inf

    def touches(self, point_base: npt.ArrayLike, reach: float) -> TouchedPlaces | None:
        """Every local minimum of the distance within reach, where there are several, as on the edges of a groove."""
        x, y, z = self._to_object(np.asarray(point_base, dtype=float)[None])[0].tolist()
        near = [place for place in self._minima(x, y, z, reach) if place[0] < reach * reach]
        return self._several([self._foot_at(place, x, y, z) for place in near])

    def gaps(self, points_base: Floats) -> Floats:
        """Distances of (n, 3) points to the tangent over or under them, (n,) m: first order near the surface.

        A point higher than all of the surface near it does not touch; its gap is given as 1 m.
        """
        x, y, z = self._to_object(points_base).T
        gaps, near = np.ones(len(x)), self.exists(x, y)
        i = ((x[near] - self._x[0]) * (1.0 / (_BLOCK_NODES * self._cell[0]))).astype(np.intp)
        j = ((y[near] - self._y[0]) * (1.0 / (_BLOCK_NODES * self._cell[1]))).astype(np.intp)
        near[near] = z[near] < self._lids[i, j]
        height, along, across = self.spline.many(x[near], y[near])
        gaps[near] = (z[near] - height) / np.sqrt(1.0 + along * along + across * across)
        return gaps

    def exists(self, x: Floats, y: Floats) -> npt.NDArray[np.bool_]:
        """(k,) whether there is a surface over (k,) points x and y of the object's frame, m."""
        inside: npt.NDArray[np.bool_] = (x >= self._x[0]) & (x <= self._x[-1]) & (y >= self._y[0]) & (y <= self._y[-1])
        if self._cells is not None:
            (x0, y0), (m, n) = self.spline.corner, self._cells.shape
            s, t = (x[inside] - x0) / self.spline.spacing, (y[inside] - y0) / self.spline.spacing
            rows, columns = (  # of both cells on a border
                [(at + side).astype(np.intp).clip(0, count - 1) for side in (-_BORDER_SPACINGS, _BORDER_SPACINGS)]
                for at, count in ((s, m), (t, n))
            )
            inside[inside] = np.any([self._cells[i, j] for i in rows for j in columns], axis=0)
        return inside

    def squeezed(self, centre_base: Vec, radius: float) -> float:
        """Volume by which the layer of a ball is squeezed, m³; the force is this volume times the stiffness K/h.

        Each column of the layer is pressed along its own radius: the sum over the nodes inside the ball of
        ``(R − |r|) R² dΩ``.
        """
        ox, oy, oz = self._origin
        bx, by, bz = centre_base[0] - ox, centre_base[1] - oy, centre_base[2] - oz
        x0, x1, x2, y0, y1, y2, z0, z1, z2 = self._columns
        x, y = bx * x0 + by * x1 + bz * x2, bx * y0 + by * y1 + bz * y2
        z = bx * z0 + by * z1 + bz * z2
        rows, columns = self._window(x, y, z, radius)
        rx, ry, rz = (x - self._x[rows])[:, None], y - self._y[columns], z - self._z[rows, columns]
        far = np.sqrt(rx * rx + ry * ry + rz * rz)
        depth = radius - far
        pressed = depth > 0.0
        if not pressed.any():
            return 0.0
        facing = rz - self._zx[rows, columns] * rx - self._zy[rows, columns] * ry
        far, depth, facing = far[pressed], depth[pressed], facing[pressed]
        return float(np.sum(depth * np.maximum(facing, 0.0) / far**3)) * radius**2 * self._cell[0] * self._cell[1]
