"""Meshes as programs and scanners write them, put in order: vertices at one place, facets that face one way.

An STL file has each vertex once a facet, and many exports round each copy for itself: what should be one vertex lies a
few nanometres apart. And single facets are turned over, with their normal into the body. Either makes the normals of
the vertices wrong, and with them the curvature.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from canprobe.mechanics.types import Floats

Index = npt.NDArray[np.intp]

MERGE_SHARE = 1e-3
"""Distance of vertices that are one, over the usual shortest edge of a facet: less than any detail that has facets."""
MAX_COORDINATE_M = 1e6
"""Largest coordinate of a mesh, m."""


@dataclass(frozen=True, slots=True)
class MeshState:
    """What a mesh was like, and what was put in order.

    Attributes:
        vertices, facets: numbers of both that are left.
        merged: number of vertices that were taken as one with another, copies at the very same place not counted.
        merged_m: largest distance between vertices that were taken as one, m.
        turned: number of facets that were turned over.
        open_edges: number of edges that belong to one facet only; 0: the mesh is watertight.
        odd_edges: number of edges that belong to more than two facets.
    """

    vertices: int
    facets: int
    merged: int
    merged_m: float
    turned: int
    open_edges: int
    odd_edges: int


def repaired(points: Floats, corners: Index) -> tuple[Floats, Index, MeshState]:
    """A mesh with merged vertices, without empty facets, and with all facets of a part facing as most of them do.

    Args:
        points: (k, 3) vertices, m.
        corners: (f, 3) indices of vertices.

    Returns:
        Vertices (m, 3), facets (g, 3), and what was found.

    Raises:
        ValueError: the arrays are not a mesh, no facet has an area, or a closed mesh is inside out.
    """
    _refuse_no_mesh(points, corners)
    points, places = np.unique(points, axis=0, return_inverse=True)
    corners = places.reshape(-1)[corners]
    unique = len(points)
    points, corners, moved = _merged(points, corners)
    a, b, c = (points[corners[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    corners = corners[area > 0.0]
    if not len(corners):
        raise ValueError("no facet of the mesh has an area: export it again")
    corners, turned, counts = _oriented(corners)
    open_edges, odd_edges = int((counts == 1).sum()), int((counts > 2).sum())
    if not open_edges and not odd_edges:
        a, b, c = (points[corners[:, k]] for k in range(3))
        if np.einsum("ij,ij->", a, np.cross(b, c)) < 0.0:
            raise ValueError("the mesh is inside out (its volume is negative): turn its faces round")
    merged = unique - len(points)
    return points, corners, MeshState(len(points), len(corners), merged, moved, turned, open_edges, odd_edges)


def _refuse_no_mesh(points: Floats, corners: Index) -> None:
    if points.ndim != 2 or points.shape[1] != 3 or corners.ndim != 2 or corners.shape[1] != 3 or not len(corners):
        raise ValueError(f"a mesh needs vertices (k, 3) and faces (f, 3), got {points.shape} and {corners.shape}")
    if not (np.abs(points) < MAX_COORDINATE_M).all():
        odd = points[~(np.abs(points) < MAX_COORDINATE_M).all(axis=1)][0].tolist()
        raise ValueError(
            f"vertices of a mesh must be finite and below {MAX_COORDINATE_M:g} m, got {odd}: export it again"
        )
    if corners.min() < 0 or corners.max() >= len(points):
        raise ValueError(
            f"faces name vertices 0 to {len(points) - 1}, got {corners.min()} to {corners.max()}: export it again"
        )


def _merged(points: Floats, corners: Index) -> tuple[Floats, Index, float]:
    """The mesh with vertices that are almost at one place made one vertex, and the largest distance of two such, m."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    triangles = points[corners]
    shortest = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).min(axis=1)
    usual = float(np.median(shortest[shortest > 0.0])) if (shortest > 0.0).any() else 0.0
    pairs = cKDTree(points).query_pairs(MERGE_SHARE * usual, output_type="ndarray")
    if not len(pairs):
        return points, corners, 0.0
    near = coo_array((np.ones(len(pairs), dtype=bool), pairs.T), shape=(len(points),) * 2)
    count, owner = connected_components(near, directed=False)
    size = np.bincount(owner, minlength=count)
    middles = np.column_stack([np.bincount(owner, points[:, k], minlength=count) for k in range(3)]) / size[:, None]
    moved = float(np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1).max())
    return middles, owner.astype(np.intp)[corners], moved


def _oriented(corners: Index) -> tuple[Index, int, Index]:
    """Facets that face one way, how many were turned over for that, and how many facets each edge has."""
    # neighbours across an edge go along it in opposite directions. Each facet stands twice in a graph, as it is and
    # turned over, and an edge connects those of two facets that agree; of a connected part most facets stay as they
    # are.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(corners)
    ends = np.concatenate((corners[:, (0, 1)], corners[:, (1, 2)], corners[:, (2, 0)]))
    face = np.tile(np.arange(n), 3)
    order = np.lexsort(np.sort(ends, axis=1).T)
    ends, face = ends[order], face[order]
    edges = np.sort(ends, axis=1)
    begins = np.flatnonzero(np.concatenate(([True], (edges[1:] != edges[:-1]).any(axis=1))))
    counts = np.diff(np.append(begins, len(edges)))
    first = begins[counts == 2]
    a, b, same = face[first], face[first + 1], ends[first, 0] == ends[first + 1, 0]
    joined = np.concatenate((np.column_stack((a, b + n * same)), np.column_stack((a + n, b + n * ~same))))
    graph = coo_array((np.ones(len(joined), dtype=bool), joined.T), shape=(2 * n, 2 * n))
    _, part = connected_components(graph, directed=False)
    kept = np.bincount(part[:n], minlength=part.max() + 1)  # facets that a part has as they are
    over = kept[part[:n]] < kept[part[n:]]
    corners = np.where(over[:, None], corners[:, ::-1], corners)
    return corners, int(over.sum()), counts
