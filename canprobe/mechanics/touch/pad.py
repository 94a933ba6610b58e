"""The geometry of a tactile array: where its taxels are, and what their counts mean.

Pad coordinates: u along the columns, v along the rows, z out of the pad, origin in the middle of the array. On a sphere
(u, v) are lengths along its surface from the pole (exponential map), on a flat array they are its plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import UsageError
from canprobe.mechanics.touch.checks import read_only
from canprobe.mechanics.types import Floats

COUNTS_MAX = 255
"""Counts of an image at full scale; 0 is no pressure. What a device counts instead its wire converts."""
THRESHOLD_COUNTS = 5
"""Least count of an image that is not taken as 0."""
_SIDES = 32
FLAT_RADIUS_M = 10.0
"""Radius of the sphere that a flat pad is taken for where a radius is needed: 8 µm deep over one inch."""


@dataclass(frozen=True, eq=False)
class Pad:
    """Taxels of one array.

    Its images are (rows, columns) counts, row by row. An array that is a list of taxels has such images too, with
    `positions` in the same order.

    Attributes:
        rows, columns: shape of the images.
        pitch_m: distance of neighbours, m; its square is the area that one taxel stands for. Of a grid with two
            distances it is the root of their product.
        full_scale_pa: pressure at `COUNTS_MAX` counts, Pa.
        mount_radius_m: radius of the sphere that the array is wrapped on, m; None for a flat array.
        positions: (rows · columns, 3) places of listed taxels, m; None for a grid of the pitch.
        normals: (rows · columns, 3) outward unit normals of listed taxels; None: a grid has those of its sphere, a list
            has z.
        cell_m: sides along u and v of the area that a listed taxel stands for, m; None: a square of the pitch.
    """

    rows: int = 16
    columns: int = 16
    pitch_m: float = 1.5875e-3
    full_scale_pa: float = 100e3
    mount_radius_m: float | None = 0.040
    positions: Floats | None = None
    normals: Floats | None = None
    cell_m: tuple[float, float] | None = None

    @classmethod
    def of_grid(cls, rows: int, columns: int, pitches_m: tuple[float, float], **more: Any) -> Pad:
        """The pad of a grid with distances of its columns and of its rows; where they differ, a list of taxels."""
        u_pitch, v_pitch = pitches_m
        if u_pitch == v_pitch:
            return cls(rows, columns, u_pitch, **more)
        v, u = np.meshgrid(v_pitch * _centred(rows), u_pitch * _centred(columns), indexing="ij")
        places = np.stack((u, v, np.zeros_like(u)), axis=-1).reshape(-1, 3)
        return cls(rows, columns, math.sqrt(u_pitch * v_pitch), positions=places, cell_m=pitches_m, **more)

    def __post_init__(self) -> None:
        for name in ("pitch_m", "full_scale_pa", "radius_m"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise UsageError(f"{name}: expected a number above 0, got {getattr(self, name)!r}")
        for name in ("positions", "normals"):
            given = getattr(self, name)
            if given is not None and np.shape(given) != (self.taxels, 3):
                raise UsageError(f"{name}: expected {self.taxels} points of 3 coordinates, got shape {np.shape(given)}")

    def lightness(self, peak_pa: float) -> float:
        """Level over the peak pressure of an image (Pa), at most 1: a light touch presses few taxels.

        The level is the first count above the threshold. Errors of force, moments and place grow with the lightness.
        """
        level_pa = self.full_scale_pa * (THRESHOLD_COUNTS + 1) / COUNTS_MAX
        return level_pa / peak_pa if peak_pa > level_pa else 1.0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of its images."""
        return self.rows, self.columns

    @property
    def taxels(self) -> int:
        """Number of taxels."""
        return self.rows * self.columns

    @property
    def is_flat(self) -> bool:
        """Whether the array is mounted flat, on no sphere."""
        return self.mount_radius_m is None

    @property
    def is_grid(self) -> bool:
        """Whether the taxels are a grid of rows, columns and one pitch, whose patches show the curvature."""
        return self.positions is None

    @property
    def radius_m(self) -> float:
        """Radius of the sphere that the array is wrapped on, or that a flat pad is taken for, m."""
        return FLAT_RADIUS_M if self.mount_radius_m is None else self.mount_radius_m

    @property
    def reach_m(self) -> float:
        """Distance from the middle to the nearest edge, m."""
        return float(self.half_sides_m.min())

    @property
    def half_sides_m(self) -> Floats:
        """(2,) distances along u and v from the middle to the edges, m."""
        if self.positions is None:
            return 0.5 * self.pitch_m * np.array((self.columns, self.rows), dtype=np.float64)
        half: Floats = np.abs(self.uv).max(axis=0) + 0.5 * np.array(self.cell_m or (self.pitch_m, self.pitch_m))
        return half

    @cached_property
    def sides(self) -> NDArray[np.bool_]:
        """(directions, taxels) whether a listed taxel is outermost in a direction, to half a pitch.

        The direction opposite to the i-th of n is the (i + n/2)-th. There is none where all taxels are outermost:
        such a list does not show where a contact ends.
        """
        angles = np.arange(_SIDES) * (2.0 * math.pi / _SIDES)
        along = np.stack((np.cos(angles), np.sin(angles)), axis=1) @ self.uv.T
        outermost: NDArray[np.bool_] = along >= along.max(axis=1, keepdims=True) - 0.5 * self.pitch_m
        return outermost[:0] if outermost.any(axis=0).all() else outermost

    @cached_property
    def uv(self) -> Floats:
        """(rows · columns, 2) pad coordinates of the taxels, m."""
        if self.positions is not None:
            return read_only(np.asarray(self.positions)[:, :2])
        v, u = np.meshgrid(_centred(self.rows), _centred(self.columns), indexing="ij")
        return read_only(self.pitch_m * np.stack((u.reshape(-1), v.reshape(-1)), axis=1))

    @cached_property
    def areas(self) -> Floats:
        """(rows · columns,) area that each taxel stands for, m².

        A taxel of a grid on a sphere has `pitch² · sin(ρ)/ρ` with ρ = √(u² + v²)/R. A listed taxel has the part of its
        area across z, so that pressure times area is the force along z; on a sphere without normals that of a grid.
        """
        tilt: Floats = np.sinc(np.hypot(*self.uv.T) / self.radius_m / math.pi)
        if self.positions is not None and self.normals is not None:
            tilt = np.asarray(self.normals, dtype=np.float64)[:, 2]
        elif self.positions is not None and self.is_flat:
            tilt = np.ones(self.taxels)
        return read_only(self.pitch_m**2 * tilt)


def _centred(count: int) -> Floats:
    """−(count − 1)/2 … (count − 1)/2."""
    return np.arange(count, dtype=np.float64) - (count - 1) / 2
