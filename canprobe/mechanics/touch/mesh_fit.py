"""A mesh as one smooth surface: its heights over a grid, as seen from +z.

The vertices of a mesh of a smooth body lie on the body, its facets do not. A bicubic spline is fitted by least squares
to the vertices; where facets are larger than the grid's spacing, points of curved triangles (PN triangles, from the
vertices and their normals) fill them. Edges that turn by more than 30 degrees stay edges, others are taken as curved.
The surface ends with the facets: a node beyond their border, or over a hole in them, has no surface.

The fit is not true at sharp edges, which become round over two spacings to each side; on walls steeper than 70 degrees,
which are bridged; and under overhangs, which are not seen.

Source: Vlachos et al., Curved PN triangles, I3D 2001; Max, Weights for computing vertex normals, JGT 4, 1999.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from canprobe.mechanics.touch.heights import MIN_NODES, Heights, Spline, b_splines
from canprobe.mechanics.touch.mesh_curvature import CurvatureError, VertexCurvature
from canprobe.mechanics.touch.mesh_repair import Index, MeshState, repaired
from canprobe.mechanics.touch.shapes import require_positive
from canprobe.mechanics.types import Floats

USUAL_SPACING_M = 1e-3
SPACINGS_BY_EDGE = np.array([0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 4.5])
"""Spacings that are tried where the first one has not the curvature of the mesh, over the usual length of its edges."""
WORTH_SHARE = 0.7
"""Share of the error of the curvature that another spacing must leave at most, to be named."""
MAX_TRIED_NODES = 200_000
"""Nodes of the largest grid that is tried."""
MIN_EDGE_RAD = np.radians(30.0)
"""Least angle between two facets that counts as an edge; a smaller one is taken as curved."""
MAX_FACET_TURN_RAD = np.radians(15.0)
"""Largest median angle between the facets of a curved surface; coarser facets do not show its curvature."""
MIN_WALL_COSINE = np.cos(np.radians(70.0))
"""Least z of a facet's unit normal; a facet that is steeper is a wall, which is bridged."""
HIDDEN_DEPTH_SPACINGS = 6.0
"""Depth below the highest sample of a cell, in spacings, from which on a sample counts as hidden."""
MIN_COVERED_SHARE = 0.1
"""Least share of the grid that has a surface; below it single vertices far away make the grid."""
MAX_NODES = 1_000_000
MAX_SAMPLES = 8_000_000
RINGING_SPACINGS, EDGE_NODES = 0.02, 3
"""Distance of a sample from the fit, in spacings, that shows a wall, and number of nodes round it that are rounded."""
FILL_WEIGHT = 0.01
"""Weight of a point of a curved triangle over that of a vertex: a vertex is exact, such points only fill gaps."""
FILL_SHARE = 0.6
"""Distance of such points over the spacing: with one in each cell alternating errors of the fit would not show."""
BORDER_SPACINGS = 1e-3
"""Distance beyond the border, in spacings, up to which a node lies on it: files have single precision."""
_SMOOTHING_WEIGHT = 1e-7
"""Weight of second differences in the fit, per sample of a cell: it only matters where there are no samples."""


@dataclass(frozen=True, slots=True, eq=False)
class HeightGrid:
    """Heights of a mesh over a grid, as `Heights` takes them.

    Attributes:
        heights: (m, n) heights, m.
        spacing: spacing of the nodes, m.
        origin: (2,) reference point, from the grid's middle, m.
        there: (m, n) whether the mesh has a surface at a node.
        state: what was put in order in the mesh.
        curvature: how far its curvature is from that of the mesh; None where the vertices do not show that.
        better: a spacing, m, by which the curvature is nearer, and how near; None where none is known.
    """

    heights: Floats
    spacing: float
    origin: tuple[float, float]
    there: npt.NDArray[np.bool_]
    state: MeshState
    curvature: CurvatureError | None
    better: tuple[float, CurvatureError] | None = None


class MeshHeights(Heights):
    """A mesh, seen from +z of its frame.

    Args:
        T_base_object: (4, 4) pose, m.
        fit: its heights.

    Raises:
        ValueError: there is no surface over the origin.
    """

    def __init__(self, T_base_object: npt.ArrayLike, fit: HeightGrid) -> None:
        super().__init__(T_base_object, fit.heights, fit.spacing, fit.origin, fit.there)
        self.fit = fit

    @classmethod
    def of(
        cls,
        T_base_object: npt.ArrayLike,
        vertices: npt.ArrayLike,
        faces: npt.ArrayLike,
        spacing: float | None,
        origin: npt.ArrayLike | None = None,
    ) -> Self:
        """The surface of a mesh; arguments as for `fit_mesh`."""
        return cls(T_base_object, fit_mesh(vertices, faces, spacing, origin))


def fit_mesh(
    vertices: npt.ArrayLike, faces: npt.ArrayLike, spacing: float | None = None, origin: npt.ArrayLike | None = None
) -> HeightGrid:
    """Heights of a mesh over x and y.

    Args:
        vertices: (k, 3) vertices, m.
        faces: (f, 3) indices of vertices, counter-clockwise as seen from outside.
        spacing: spacing of the grid, m. None: 1 mm, or the one that has the curvature of the mesh where that has not.
        origin: (2,) x and y of the point that becomes the object's origin, m; None for the middle of the mesh.

    Raises:
        ValueError: the arrays are not a mesh, or the mesh is not seen from +z, inside out, too coarse or too large.
    """
    if spacing is not None:
        require_positive(spacing=spacing)
    points, corners, state = repaired(np.asarray(vertices, dtype=float), np.asarray(faces, dtype=np.intp))
    normals = np.cross(points[corners[:, 1]] - points[corners[:, 0]], points[corners[:, 2]] - points[corners[:, 0]])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    up = normals[:, 2] > MIN_WALL_COSINE
    if not up.any():
        raise ValueError("no facet of the mesh faces +z: its faces are inside out, or it must be turned")
    _refuse_coarse(points, corners[up], normals[up])
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))[:2]
    at = middle if origin is None else np.asarray(origin, dtype=float)
    surfaces = _Surfaces((points, corners, normals, up), at, state)
    first = surfaces.fit(USUAL_SPACING_M if spacing is None else spacing)
    if first.curvature is None or first.curvature.is_small:
        return first
    triangles = points[corners[up]]
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2)
    others = [first, *surfaces.fits(SPACINGS_BY_EDGE * np.median(edges))]
    best, error = min(
        ((one, one.curvature) for one in others if one.curvature is not None), key=lambda pair: pair[1].error
    )
    if spacing is None:
        return best
    return replace(first, better=(best.spacing, error)) if error.error < WORTH_SHARE * first.curvature.error else first


class _Surfaces:
    """The surfaces of one mesh by different spacings.

    Args:
        mesh: vertices (k, 3), m, facets (f, 3), their unit normals (f, 3), and (f,) which of them are no walls.
        at: (2,) x and y of the origin, m.
        state: what was put in order in the mesh.
    """

    def __init__(
        self,
        mesh: tuple[Floats, Index, Floats, npt.NDArray[np.bool_]],
        at: Floats,
        state: MeshState,
    ) -> None:
        self._mesh, self._at, self._state = mesh, at, state
        points, corners, normals, up = mesh
        self._exact = points[np.unique(corners[up])]
        self._facing = points[corners[normals[:, 2] > 0.0]][:, :, :2]  # walls too, as they are bridged
        self._shown = VertexCurvature.of(self._exact)

    def fit(self, spacing: float) -> HeightGrid:
        """The surface by a spacing, m.

        Raises:
            ValueError: there is none, or it is too large.
        """
        filled = _samples(*self._mesh, spacing)
        weights = np.repeat((1.0, FILL_WEIGHT), (len(self._exact), len(filled)))
        samples = np.concatenate((self._exact, filled))
        seen = _seen(samples, spacing)
        heights, middle, there = _fitted(samples[seen], weights[seen], self._facing, spacing)
        corner = middle - 0.5 * spacing * (np.array(heights.shape) - 1)
        curvature = self._shown.against(Spline(heights, spacing, tuple(corner.tolist())))
        ox, oy = (self._at - middle).tolist()
        return HeightGrid(heights, spacing, (ox, oy), there, self._state, curvature)

    def fits(self, spacings: Floats) -> Iterator[HeightGrid]:
        """Those of the surfaces by spacings (n,), m, that there are, and that cost little."""
        room = float(np.prod(np.ptp(self._exact[:, :2], axis=0)))
        for spacing in spacings[spacings**2 * MAX_TRIED_NODES > room].tolist():
            with contextlib.suppress(ValueError):
                yield self.fit(spacing)


def _refuse_coarse(points: Floats, corners: Index, normals: Floats) -> None:
    ends = np.sort(np.concatenate((corners[:, (0, 1)], corners[:, (1, 2)], corners[:, (2, 0)])), axis=1)
    faces = np.tile(np.arange(len(corners)), 3)
    order = np.lexsort(ends.T)
    ends, faces = ends[order], faces[order]
    shared = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
    angles = np.arccos(np.clip(np.sum(normals[faces[shared]] * normals[faces[shared + 1]], axis=1), -1.0, 1.0))
    curved = (angles > 1e-3) & (angles < MIN_EDGE_RAD)
    if curved.any() and np.median(angles[curved]) > MAX_FACET_TURN_RAD:
        long = np.linalg.norm(points[ends[shared, 0]] - points[ends[shared, 1]], axis=1)[curved]
        raise ValueError(
            f"the mesh is too coarse: facets of about {1e3 * np.median(long):.3g} mm turn the normal by "
            f"{np.degrees(np.median(angles[curved])):.0f} deg from one to the next, at most "
            f"{np.degrees(MAX_FACET_TURN_RAD):.0f} deg; export it finer"
        )


def _samples(points: Floats, corners: Index, normals: Floats, up: npt.NDArray[np.bool_], apart: float) -> Floats:
    """(k, 3) points of curved triangles where the vertices are farther apart than `apart`, m."""
    # they stand in rows along the longest side: a long sliver, as CAD programs write them, has as many as its area asks
    edges = _corner_normals(points, corners, normals)[up]
    triangles = points[corners[up]]
    sides = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2)  # from the corner before to each
    longest = sides.max(axis=1)
    first = (sides.argmax(axis=1)[:, None] + np.arange(1, 4)) % 3  # the corner opposite to the longest side leads
    triangles, edges = (np.take_along_axis(of, first[:, :, None], axis=1) for of in (triangles, edges))
    double = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    along, across = (
        np.where(longest > apart, np.ceil(one / (FILL_SHARE * apart)), 1.0).astype(np.intp).clip(1)
        for one in (longest, double / longest)
    )
    if (count := float(np.sum((along + 2.0) * (across + 1.0) / 2.0))) > MAX_SAMPLES:
        raise ValueError(f"the mesh gives {count:.2g} samples at this spacing, at most {MAX_SAMPLES:.0g}: widen it")
    found = [np.empty((0, 3))]
    for n, rows in np.unique(np.column_stack((along, across))[along > 1], axis=0).tolist():
        chosen = (along == n) & (across == rows)
        found.append(_curved(triangles[chosen], edges[chosen], n, rows))
    return np.concatenate(found)


def _corner_normals(points: Floats, corners: Index, normals: Floats) -> Floats:
    """(f, 3, 3) normal of the body at each corner of each facet, from the facets there that no edge parts from it."""
    # the weights are exact on a ball
    weighted = np.empty((len(corners), 3, 3))
    for k in range(3):
        a, b = (points[corners[:, (k + j) % 3]] - points[corners[:, k]] for j in (1, 2))
        weighted[:, k] = np.cross(a, b) / (np.sum(a * a, axis=1) * np.sum(b * b, axis=1))[:, None]
    flat = corners.ravel()
    order = np.argsort(flat, kind="stable")
    vertex, face, weight = flat[order], order // 3, weighted.reshape(-1, 3)[order]
    first = np.searchsorted(vertex, vertex, side="left")
    beyond = np.searchsorted(vertex, vertex, side="right")
    total, still, step = np.zeros_like(weight), np.arange(len(vertex)), 0
    while len(still):
        other = first[still] + step
        near = np.sum(normals[face[still]] * normals[face[other]], axis=1) > np.cos(MIN_EDGE_RAD)
        total[still] += weight[other] * near[:, None]
        step += 1
        still = still[first[still] + step < beyond[still]]
    corner = np.empty_like(total)
    corner[order] = total / np.linalg.norm(total, axis=1)[:, None]
    return corner.reshape(-1, 3, 3)


def _curved(triangles: Floats, normals: Floats, along: int, across: int) -> Floats:
    """(k, 3) points of PN triangles (f, 3, 3) with normals (f, 3, 3) at their corners."""
    # they lie in `across` rows from the first corner to the side opposite to it, that with `along` parts
    away = np.arange(across + 1) / across
    parts = np.ceil(along * away - 1e-9).astype(np.intp).clip(1)
    row = np.repeat(away, parts + 1)
    place = np.concatenate([np.arange(n + 1) / n for n in parts.tolist()]) * row
    share = np.stack((1.0 - row, row - place, place))[:, 1:]  # barycentric; the first row is one corner
    on_sides = np.zeros((len(triangles), 3))
    points = np.zeros((len(triangles), share.shape[1], 3))
    for a in range(3):
        points += share[a][None, :, None] ** 3 * triangles[:, a, None]
        for b in ((a + 1) % 3, (a + 2) % 3):
            rise = np.sum((triangles[:, b] - triangles[:, a]) * normals[:, a], axis=1)
            control = (2.0 * triangles[:, a] + triangles[:, b] - rise[:, None] * normals[:, a]) / 3.0
            points += 3.0 * (share[a] ** 2 * share[b])[None, :, None] * control[:, None]
            on_sides += control / 6.0
    middle = 1.5 * on_sides - 0.5 * triangles.mean(axis=1)
    points += 6.0 * (share[0] * share[1] * share[2])[None, :, None] * middle[:, None]
    return points.reshape(-1, 3)


def _seen(samples: Floats, spacing: float) -> npt.NDArray[np.bool_]:
    """(k,) the samples that no others hide from +z."""
    cells = np.floor(samples[:, :2] / spacing).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    top = np.full(cell.max() + 1, -np.inf)
    np.maximum.at(top, cell, samples[:, 2])
    return samples[:, 2] >= top[cell] - HIDDEN_DEPTH_SPACINGS * spacing


def _covered(triangles: Floats, shape: tuple[int, ...]) -> npt.NDArray[np.bool_]:
    """Which nodes of a grid lie in triangles (f, 3, 2) over it, in spacings from its corner."""
    first = np.ceil(triangles[:, :, 0].min(axis=1) - BORDER_SPACINGS).astype(np.intp).clip(0)
    last = np.floor(triangles[:, :, 0].max(axis=1) + BORDER_SPACINGS).astype(np.intp).clip(max=shape[0] - 1)
    rows = (last - first + 1).clip(0)
    row = np.arange(rows.sum()) + np.repeat(first - np.cumsum(rows) + rows, rows)
    a = np.repeat(triangles, rows, axis=0)
    b = np.roll(a, 1, axis=1)
    ends = np.sort(np.stack((a[:, :, 0], b[:, :, 0])), axis=0)
    crossed = (ends[0] <= row[:, None] + BORDER_SPACINGS) & (row[:, None] - BORDER_SPACINGS <= ends[1])
    along = np.where(ends[1] > ends[0], b[:, :, 0] - a[:, :, 0], 1.0)
    share = ((row[:, None] - a[:, :, 0]) / along).clip(0.0, 1.0)
    y = a[:, :, 1] + share * (b[:, :, 1] - a[:, :, 1])  # where the row crosses each side
    low = np.ceil(np.where(crossed, y, np.inf).min(axis=1) - BORDER_SPACINGS).clip(0, shape[1]).astype(np.intp)
    high = np.floor(np.where(crossed, y, -np.inf).max(axis=1) + BORDER_SPACINGS).clip(-1, shape[1] - 1).astype(np.intp)
    begun = np.zeros((shape[0], shape[1] + 1), dtype=np.intp)
    np.add.at(begun, (row, low), 1)
    np.add.at(begun, (row, np.maximum(high + 1, low)), -1)
    covered: npt.NDArray[np.bool_] = np.cumsum(begun, axis=1)[:, :-1] > 0
    # A node between four covered ones lies in a gap of less than two spacings, where a facet is missing: it is bridged.
    covered[1:-1, 1:-1] |= covered[:-2, 1:-1] & covered[2:, 1:-1] & covered[1:-1, :-2] & covered[1:-1, 2:]
    return covered


def _fitted(
    samples: Floats, weights: Floats, facing: Floats, spacing: float
) -> tuple[Floats, Floats, npt.NDArray[np.bool_]]:
    """The least-squares spline: heights at the grid's nodes, its middle (2,), and whether there is a surface."""
    # `facing` (f, 3, 2) are all facets that face upwards
    from scipy import ndimage, sparse  # only where a mesh is read
    from scipy.sparse.linalg import splu

    low, high = samples[:, :2].min(axis=0), samples[:, :2].max(axis=0)
    cells = np.floor((high - low) / spacing + BORDER_SPACINGS).astype(int)  # the grid ends within the samples
    x, y = 1e3 * (high - low)
    if cells.min() < MIN_NODES - 1:
        least = f"narrower than {MIN_NODES - 1} spacings of {1e3 * spacing:.3g} mm"
        raise ValueError(f"what is seen of the mesh from +z is {x:.3g} mm by {y:.3g} mm, {least}")
    if np.prod(cells + 1.0) > MAX_NODES:
        raise ValueError(
            f"the mesh is {x:.3g} mm by {y:.3g} mm: more than {MAX_NODES:.0g} nodes at {1e3 * spacing:.3g} mm; widen"
            " the spacing, or remove vertices far away"
        )
    corner = 0.5 * (low + high) - 0.5 * cells * spacing
    m, n = (int(one) + 3 for one in cells)  # coefficients along x and y
    place = (samples[:, :2] - corner) / spacing
    cell = np.clip(place.astype(np.intp), 0, cells - 1)  # those beyond the grid belong to the cubics of its border
    bx, by = (np.stack(b_splines((place - cell)[:, axis])[0], axis=1) for axis in (0, 1))
    columns = (cell[:, 0, None] + np.arange(4))[:, :, None] * n + (cell[:, 1, None] + np.arange(4))[:, None, :]
    filled = np.zeros((m - 1, n - 1), dtype=bool)
    filled[cell[:, 0] + 1, cell[:, 1] + 1] = True
    there = filled[:-1, :-1] | filled[1:, :-1] | filled[:-1, 1:] | filled[1:, 1:]
    there &= _covered((facing - corner) / spacing, there.shape)
    nearly_empty = f"the mesh is {x:.3g} mm by {y:.3g} mm and nearly empty: remove vertices far away"
    if there.mean() < MIN_COVERED_SHARE:
        raise ValueError(nearly_empty)
    values = bx[:, :, None] * by[:, None, :]
    count = len(samples)
    A = sparse.csr_array((values.ravel(), (np.repeat(np.arange(count), 16), columns.ravel())), shape=(count, m * n))
    bends = [sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(k - 2, k)) for k in (m, n)]
    along, across = sparse.kron(bends[0], sparse.identity(n)), sparse.kron(sparse.identity(m), bends[1])
    weighted = A.T @ sparse.diags_array(weights)
    weak = _SMOOTHING_WEIGHT * max(count / (m * n), 1.0)
    normal = weighted @ A + weak * (along.T @ along + across.T @ across)
    try:
        factors = splu(
            normal.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
    except RuntimeError as error:  # singular
        raise ValueError(nearly_empty) from error
    found = factors.solve(weighted @ samples[:, 2])
    c = found.reshape(m, n)
    c = (c[:-2] + 4.0 * c[1:-1] + c[2:]) / 6.0
    heights = (c[:, :-2] + 4.0 * c[:, 1:-1] + c[:, 2:]) / 6.0
    off = np.abs(A @ found - samples[:, 2]) > RINGING_SPACINGS * spacing
    if off.any():  # beside a wall the fit rings: there the mean of what is near rounds the edges
        edges = np.zeros(heights.shape, dtype=bool)
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            edges[cell[off, 0] + i, cell[off, 1] + j] = True
        edges = ndimage.binary_dilation(edges, iterations=EDGE_NODES)
        near = (A.T @ np.ones(count)).reshape(m, n)[1:-1, 1:-1]
        edges &= near > 0.0
        heights[edges] = (A.T @ samples[:, 2]).reshape(m, n)[1:-1, 1:-1][edges] / near[edges]
    return heights, 0.5 * (low + high), there
