"""The ground of a rectangle: in each cell the deviation of the height that the surface map states.

A cell is fitted as the map fits its own: one quartic to the nodes round it. Its variance is that of the quartic, more
where the contacts scatter more than their noise explains, and what no path can shrink: the height by the error of the
layer's stiffness, which is common to the scan, and the scatter of contacts on ground that the probe cannot follow.
One cell is fitted at a time, that beside which most path was walked since its last fit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.map import nodes as column
from canprobe.mechanics.touch.map.cells import observed_of
from canprobe.mechanics.touch.map.discs import Discs
from canprobe.mechanics.touch.map.local_fits import fit_discs, stiffness_error
from canprobe.mechanics.touch.map.quartic import LENGTH_M, THIRD
from canprobe.mechanics.touch.map.surface_map import REACH_M, SurfaceMap
from canprobe.mechanics.touch.strategies import Rectangle
from canprobe.mechanics.touch.tangent_frames import tangent_rotation
from canprobe.mechanics.types import Floats

UNKNOWN_M = 1e-3
"""Deviation of the height where nothing was touched, m: more says nothing about where to go."""
CELL_M = 3e-3
"""Largest side of a cell, m."""
FIT_REACH_M = 6e-3
"""Distance from a cell at which new path makes its fit stale, m: the least radius of a fit."""
NEAR_FLOOR = 1.1
"""A cell whose deviation is within this factor of what no path can shrink is as good as it gets."""
CHANGED_SHARE, DUE_M = 0.2, 1e-6
"""A fit that changes the curvature by more than this share of the probe's is not linear enough, and is due again, as if
this path, m, were new beside it: after all others."""


class GroundCells:
    """The cells of a rectangle of the scan plane, and what is known in each.

    Args:
        surface_map: map of the contacts, of a pad; it grows.
        origin: (3,) middle of the rectangle, m.
        axes: (3, 3) rows: length, width and outward normal of the scan plane.
        rectangle: its size, and the deviation of the height that is wanted in every cell.
        stiffness_sigma: standard deviation of the logarithm of the layer's stiffness.

    Attributes:
        places: (m, 2) middles of the cells in the scan plane, from the middle of the rectangle, m.
        sigma: (m,) stated deviation of the height, m; `UNKNOWN_M` where nothing was touched.
        floor: (m,) the part of it that no path can shrink, m.
        change: (m,) change of the curvature that the map sees there, 1/m²; NaN where nothing was touched.
        closed: (m,) cells that the probe cannot touch.
        counts: numbers of cells along and across.
        target: deviation that is wanted, m.
        common: deviation of all heights by the stiffness of the layer, m.
    """

    def __init__(
        self,
        surface_map: SurfaceMap,
        origin: Floats,
        axes: Floats,
        rectangle: Rectangle,
        *,
        stiffness_sigma: float,
    ) -> None:
        size = rectangle.length, rectangle.width
        # rounding: 9 * 1e-3 over 3e-3 is just above 3, and would make four cells
        self.counts = tuple(math.ceil(side / CELL_M - 1e-9) for side in size)
        along, across = (side * ((np.arange(n) + 0.5) / n - 0.5) for side, n in zip(size, self.counts, strict=True))
        self.places: Floats = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1).reshape(-1, 2)
        m = len(self.places)
        self.sigma, self.floor = np.full(m, UNKNOWN_M), np.zeros(m)
        self.change: Floats = np.full(m, math.nan)
        self.closed: NDArray[np.bool_] = np.zeros(m, bool)
        self.common = 0.0
        self.target, self._stiffness_sigma = rectangle.target_sigma, stiffness_sigma
        self._map, self._origin, self._axes = surface_map, origin, axes
        self._stale = np.zeros(m)
        self._height = np.full(m, math.nan)
        self._curvature = np.full((m, 3, 3), math.nan)

    def in_plane(self, point: Floats) -> tuple[float, float]:
        """Place of a point (3,), m, in the scan plane, m."""
        x, y = (self._axes[:2] @ (point - self._origin)).tolist()
        return x, y

    def in_base(self, places: Floats) -> Floats:
        """Points (n, 3) of the scan plane by their places in it (n, 2), m."""
        return self._origin + places @ self._axes[:2]

    def walk(self, point: Floats, distance: float) -> None:
        """Take path of some length, m, that was walked at a contact (3,), m."""
        x, y, height = (self._axes @ (point - self._origin)).tolist()
        near = np.hypot(self.places[:, 0] - x, self.places[:, 1] - y) < FIT_REACH_M
        self._stale[near] += distance
        self._height[near & np.isnan(self._height)] = height

    def fit_one(self) -> None:
        """Fit the cell whose fit is most out of date, if one is."""
        i = int(self._stale.argmax())
        if self._stale[i] > 0.0:
            self.fit(i)

    def fit(self, i: int) -> None:
        """Fit a cell by its index; nothing changes where no contact is near it."""
        self._stale[i] = 0.0  # also where nothing is near, else it would stay the first that is due
        pad = self._map.pad
        assert pad is not None
        up = self._axes[2]
        place = self._origin + self.places[i] @ self._axes[:2] + self._height[i] * up
        rows = self._map.nodes.near(place)
        if not len(rows):
            return
        points = self._map.nodes.points_of(rows)
        beside = np.hypot(*(self._axes[:2] @ (points - place).T))
        nearest = int(beside.argmin())
        if beside[nearest] > REACH_M:
            return
        normal = rows[nearest, column.NORMAL]
        place = place + up * float((points[nearest] - place) @ normal) / max(float(up @ normal), 0.2)
        disc = Discs.at(place, tangent_rotation(normal.tolist()), points, rows)
        tangents = disc.R[0, :, :2]
        K_ref = tangents.T @ self._curvature_near(i) @ tangents
        try:
            fits, _, _ = fit_discs(rows, disc, pad, self._map.noise, K_ref=K_ref[None], weight=disc.weight)
        except np.linalg.LinAlgError:  # of contacts that no surface explains
            return
        if observed_of(fits, fits.covariance(fits.excess))[0][0, 2]:
            self._curvature[i] = tangents @ fits.K[0] @ tangents.T
            if np.abs(fits.K[0] - K_ref).max() * pad.radius > CHANGED_SHARE:
                self._stale[i] = DUE_M
        self.change[i] = math.sqrt(float(np.mean(fits.a[0, THIRD] ** 2))) / LENGTH_M**2
        self.common = float(stiffness_error(rows, disc, pad, fits.K, self._stiffness_sigma)[0])
        variance = float(fits.covariance(fits.excess)[0, 0, 0]) * LENGTH_M**2
        floor2 = self.common**2 + float(self._map.noise.scatter2(fits.excess)[0])
        self.floor[i] = min(math.sqrt(floor2), UNKNOWN_M)
        self.sigma[i] = min(math.sqrt(floor2 + variance), UNKNOWN_M)

    def _curvature_near(self, i: int) -> Floats:
        """Curvature (3, 3) last observed in a cell, else in the nearest one with any, as a tensor in base, 1/m."""
        # the depth of the layer and the scatter of the normals follow from it: about a plane, a probe on a ridge seems
        # to contradict every smooth surface
        known = np.flatnonzero(np.isfinite(self._curvature[:, 0, 0]))
        if not len(known):
            return np.zeros((3, 3))
        away = np.hypot(*(self.places[known] - self.places[i]).T)
        nearest: Floats = self._curvature[known[away.argmin()]]
        return nearest

    def close(self, x: float, y: float, radius: float) -> None:
        """Close the cells within a distance, m, of a place of the scan plane, m, that were not touched."""
        self.closed |= (np.hypot(self.places[:, 0] - x, self.places[:, 1] - y) < radius) & (self.sigma >= UNKNOWN_M)

    @property
    def largest(self) -> float:
        """Largest stated deviation in the cells that are open, m."""
        return float(self.sigma.max(where=~self.closed, initial=0.0))

    @property
    def goal(self) -> Floats:
        """(m,) deviation at which a cell is done, m."""
        return np.maximum(self.target, NEAR_FLOOR * self.floor)

    @property
    def wanting(self) -> NDArray[np.bool_]:
        """(m,) cells that are open and above their goal."""
        return ~self.closed & (self.sigma > self.goal)
