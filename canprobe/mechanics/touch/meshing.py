"""Triangles of any surface that gives the closest point to a place: maps, and implicit surfaces.

A cubic lattice is searched cell by cell outward from seeds, so that only cells near the surface are evaluated. A cell
with corners inside and outside the body holds one vertex; it starts at the mean of the crossings of the cell's edges
and is then moved to its foot on the surface. Every edge of the lattice that crosses the surface gives a quadrilateral
of the vertices of the four cells round it. Where the surface is not defined, as beyond the reach of a map, the mesh
ends. The lattice is fixed in base: where a surface did not change, its triangles do not change.

Source: Gibson, "Constrained elastic surface nets", MICCAI 1998.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import ResultsError, UsageError
from canprobe.mechanics.types import Floats


class Feet(NamedTuple):
    """A surface as seen from n points; NaN where it does not reach.

    Attributes:
        point: (n, 3) closest points of the surface, m.
        normal: (n, 3) outward unit normals there.
        height: (n,) signed distances of the query points from the surface, m, positive outside.
        sigma: (n,) standard deviations of the surface's height, m; NaN where they are not known.
        sigma_relative: (n,) the same of its height against the rest of the surface: without what displaces all of it.
    """

    point: Floats
    normal: Floats
    height: Floats
    sigma: Floats
    sigma_relative: Floats


Field = Callable[[Floats], Feet]
"""Points (n, 3) → closest points of a surface, NaN where it is not defined."""
Numbers = NDArray[np.int64]
"""Numbers of cells or corners of the lattice."""
CELL_M = 0.5e-3
"""Default side of a cell, m."""
_BITS, _BIAS = 21, 1 << 20
_CELL_STEPS = np.array([1 << 2 * _BITS, 1 << _BITS, 1], np.int64)
"""Difference of the numbers of neighbouring cells along x, y, z; a corner has the number of the cell above it."""
_CORNERS = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
_EDGES = np.array([[a, a + step] for step, axis in ((4, 0), (2, 1), (1, 2)) for a in range(8) if not _CORNERS[a, axis]])
_NEIGHBOURS = np.array([[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)])


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A surface as triangles.

    Attributes:
        vertices: (n, 3) points on the surface, m.
        triangles: (m, 3) indices of vertices, anticlockwise seen from outside the body.
        normals: (n, 3) outward unit normals of the surface at the vertices.
        sigma, sigma_relative: (n,) standard deviations of the surface's height at the vertices, m, as those of `Feet`.
    """

    vertices: Floats
    triangles: NDArray[np.int32]
    normals: Floats
    sigma: Floats
    sigma_relative: Floats

    def save_ply(self, path: Path | str) -> None:
        """Write a binary PLY file: vertices in m, normals, `sigma` and `sigma_relative`, and triangles.

        Raises:
            ResultsError: the file cannot be written.
        """
        columns = ("x", "y", "z", "nx", "ny", "nz", "sigma", "sigma_relative")
        points = np.column_stack([self.vertices, self.normals, self.sigma, self.sigma_relative]).astype("<f4")
        faces = np.empty(len(self.triangles), [("n", "u1"), ("i", "<i4", 3)])
        faces["n"], faces["i"] = 3, self.triangles
        head = ["ply", "format binary_little_endian 1.0", "comment lengths in m", f"element vertex {len(points)}"]
        head += [f"property float {name}" for name in columns]
        head += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", ""]
        try:
            Path(path).write_bytes("\n".join(head).encode() + points.tobytes() + faces.tobytes())
        except OSError as error:
            raise ResultsError(f"{path}: cannot be written: {error.strerror or error}") from error


def mesh_of(field: Field, seeds: Floats, cell: float) -> Mesh:
    """Triangles of a surface.

    Args:
        field: the surface, as a function from points to their feet.
        seeds: (n, 3) points near it, m; every part that is connected to a cell beside one of them is found.
        cell: side of a cell of the lattice, m.

    Raises:
        UsageError: a seed is more than a million cells from the origin.
    """
    low = np.floor(seeds / cell)
    if np.abs(low).max(initial=0.0) > 0.9 * _BIAS:
        raise UsageError(
            f"cell: expected at least {np.abs(seeds).max() / (0.9 * _BIAS):.2g} m for points so far away, got {cell}"
        )
    corners, sides = _CORNERS @ _CELL_STEPS, np.concatenate([_CELL_STEPS, -_CELL_STEPS])
    todo: Numbers = np.unique(((low.astype(np.int64) + _BIAS) @ _CELL_STEPS)[:, None] + _NEIGHBOURS @ _CELL_STEPS)
    seen: Numbers = todo[:0]
    known, values = seen, np.zeros(0)
    crossed, heights = [seen], [np.zeros((0, 8))]
    while len(todo):
        new = np.setdiff1d(todo[:, None] + corners, known)
        known, values = np.concatenate([known, new]), np.concatenate([values, field(_place(new, cell)).height])
        order = np.argsort(known)
        known, values = known[order], values[order]
        height = values[np.searchsorted(known, todo[:, None] + corners)]
        cut = np.isfinite(height).all(axis=1) & (height < 0.0).any(axis=1) & (height >= 0.0).any(axis=1)
        crossed.append(todo[cut])
        heights.append(height[cut])
        seen = np.union1d(seen, todo)
        todo = np.setdiff1d(todo[cut][:, None] + sides, seen)
    cells: Numbers = np.concatenate(crossed)
    order = np.argsort(cells)
    cells, height = cells[order], np.concatenate(heights)[order]
    start = _place(cells, cell) + cell * _crossing(height)
    feet = field(start)  # twice: the first foot may be off where the start is far from the surface
    feet = field(np.where(np.isfinite(feet.point), feet.point, start))
    vertices = feet.point
    triangles = _triangles(cells, height, vertices)
    used, renumbered = np.unique(triangles, return_inverse=True)
    sigmas = feet.sigma[used], feet.sigma_relative[used]
    return Mesh(vertices[used], renumbered.reshape(-1, 3).astype(np.int32), feet.normal[used], *sigmas)


def _place(number: Numbers, cell: float) -> Floats:
    """(n, 3) places of corners, m."""
    mask = (1 << _BITS) - 1
    steps = np.stack([number >> 2 * _BITS, number >> _BITS & mask, number & mask], axis=1)
    return (steps - _BIAS) * cell


def _crossing(height: Floats) -> Floats:
    """(n, 3) mean of the places where a cell's edges meet the surface, in cells from its lowest corner."""
    a, b = height[:, _EDGES[:, 0]], height[:, _EDGES[:, 1]]
    met = (a < 0.0) != (b < 0.0)
    share = np.where(met, a / np.where(met, a - b, 1.0), 0.0)
    places = _CORNERS[_EDGES[:, 0]] + share[:, :, None] * (_CORNERS[_EDGES[:, 1]] - _CORNERS[_EDGES[:, 0]])
    result: Floats = (places * met[:, :, None]).sum(axis=1) / met.sum(axis=1)[:, None]
    return result


def _triangles(cells: Numbers, height: Floats, vertices: Floats) -> NDArray[np.intp]:
    """(m, 3) two triangles for each edge of the lattice that meets the surface amid four cells with a vertex."""
    found = [np.zeros((0, 3), np.intp)]
    finite: NDArray[np.bool_] = np.isfinite(vertices[:, 0])
    inside = height < 0.0
    for along, end in enumerate((4, 2, 1)):
        a, b = _CELL_STEPS[along - 2], _CELL_STEPS[along - 1]
        edge = np.flatnonzero(inside[:, 0] != inside[:, end])
        around = cells[edge][:, None] + np.array([-a - b, -b, 0, -a])
        index = np.minimum(np.searchsorted(cells, around), len(cells) - 1)
        whole = ((cells[index] == around) & finite[index]).all(axis=1)
        quad = np.where(inside[edge, :1], index, index[:, ::-1])[whole]
        p = vertices[quad]
        short = np.linalg.norm(p[:, 0] - p[:, 2], axis=1) <= np.linalg.norm(p[:, 1] - p[:, 3], axis=1)
        quad = np.where(short[:, None], quad, np.roll(quad, -1, axis=1))
        found += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return np.concatenate(found)
