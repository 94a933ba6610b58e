"""Cells of a map, and the nodes round each of them: which belong to one sheet of the surface."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from canprobe.mechanics.touch.map.nodes import NORMAL, PATH, facing
from canprobe.mechanics.touch.tangent_frames import tangent_rotation
from canprobe.mechanics.types import Floats

FIT_CELL_M = 3e-3
"""Side of a cell, m."""
MIN_RADIUS_M, MAX_RADIUS_M, NODES_WANTED = 5.5e-3, 12e-3, 45
"""Least and largest radius of a disc, m, and the nodes that it should hold."""
TAPER_FROM = 0.6
"""Share of the radius from which nodes fade out."""
DISCS_AT_ONCE = 1000
"""Discs whose nodes are searched at once: some 20 MB."""
MIN_FACING = 0.5
"""Least cosine between two normals of one sheet."""
SHEET_SLOPE, SHEET_M = 0.3, 0.3e-3
"""Largest rise of a chord over its length, and with it, m: beyond, its ends lie on two sheets."""


class Discs(NamedTuple):
    """Places of local fits with the nodes round them; a place is the mean of the nodes in a cell.

    Attributes:
        origin: (m, 3) places, m.
        R: (m, 3, 3) axes as columns, z the outward normal.
        nodes: (m, n) indices of nodes.
        weight: (m, n) their taper; 0 where a disc has fewer than n, and on another sheet.
        share: (m,) path of the nodes in the cell over the tapered path in the disc.
    """

    origin: Floats
    R: Floats
    nodes: NDArray[np.intp]
    weight: Floats
    share: Floats

    @classmethod
    def of(cls, points: Floats, rows: Floats) -> Discs:
        """Cells of nodes with contact points (n, 3), m, and columns (n, COLUMNS)."""
        normals = rows[:, NORMAL]
        keys = np.column_stack([np.floor(points / FIT_CELL_M).astype(np.int64), facing(normals)])
        owner = np.unique(keys, axis=0, return_inverse=True)[1].ravel()
        for _ in range(2):  # sheets that share a cell and a facing part from its first node
            first = np.unique(owner, return_index=True)[1][owner]
            chord = points - points[first]
            same = one_sheet(chord, np.linalg.norm(chord, axis=1), normals, normals[first])
            owner = np.unique(2 * owner + ~same, return_inverse=True)[1]
        size = np.bincount(owner)
        origin, up = (
            np.stack([np.bincount(owner, values[:, i]) for i in range(3)], axis=1) / size[:, None]
            for values in (points, normals)
        )
        up /= np.linalg.norm(up, axis=1)[:, None]
        tree = cKDTree(points)
        radius = _radius(tree, origin)
        starts = range(0, len(origin), DISCS_AT_ONCE)
        found = [
            _members(normals, tree, *(values[i : i + DISCS_AT_ONCE] for values in (origin, up, radius))) for i in starts
        ]
        shape = len(origin), max(members.shape[1] for members, _ in found)
        nodes, weight = np.zeros(shape, np.intp), np.zeros(shape)
        for i, (members, taper) in zip(starts, found, strict=True):
            part = slice(i, i + len(members)), slice(members.shape[1])
            nodes[part], weight[part] = members, taper
        path = rows[:, PATH]
        share = np.bincount(owner, path) / np.maximum((weight * path[nodes]).sum(axis=1), 1e-300)
        R = np.array([tangent_rotation(n) for n in up.tolist()])
        return cls(origin, R, nodes, weight, np.minimum(share, 1.0))

    @classmethod
    def at(cls, place: Floats, R: Floats, points: Floats, rows: Floats) -> Discs:
        """One disc at a place (3,), m, with axes R (3, 3), of nodes as for `of`."""
        tree, origin = cKDTree(points), place[None]
        nodes, weight = _members(rows[:, NORMAL], tree, origin, R[None, :, 2], _radius(tree, origin))
        return cls(origin, R[None], nodes, weight, np.ones(1))

    def part(self, which: slice) -> Discs:
        """Some of the discs."""
        return Discs(self.origin[which], self.R[which], self.nodes[which], self.weight[which], self.share[which])


def _radius(tree: cKDTree, origin: Floats) -> Floats:
    """(m,) radius of discs at places (m, 3), m, by the number of nodes that they should hold."""
    if tree.n < NODES_WANTED:
        return np.full(len(origin), MAX_RADIUS_M)
    wanted: Floats = np.asarray(tree.query(origin, [NODES_WANTED])[0])[:, 0]
    return np.clip(wanted, MIN_RADIUS_M, MAX_RADIUS_M)


def _members(
    normals: Floats, tree: cKDTree, origin: Floats, up: Floats, radius: Floats
) -> tuple[NDArray[np.intp], Floats]:
    """Nodes (m, n) of a tree within the radius of discs, and their taper, 0 on another sheet."""
    near = tree.query_ball_point(origin, radius)
    counts = np.array([len(one) for one in near])
    there = np.arange(counts.max()) < counts[:, None]
    nodes = np.zeros(there.shape, np.intp)
    nodes[there] = np.concatenate(near)
    chord = np.asarray(tree.data)[nodes] - origin[:, None]
    far = np.linalg.norm(chord, axis=2)
    fade = np.clip((far / radius[:, None] - TAPER_FROM) / (1.0 - TAPER_FROM), 0.0, 1.0)
    same = one_sheet(chord, far, normals[nodes], up[:, None])
    return nodes, np.where(there & same, 1.0 - fade * fade * (3.0 - 2.0 * fade), 0.0)


def one_sheet(chord: Floats, length: Floats, a: Floats, b: Floats) -> NDArray[np.bool_]:
    """Whether the ends of chords (…, 3), m, with outward normals a and b (…, 3), lie on one sheet of a surface.

    On a sphere, and nearly so on any smooth surface, a chord is at right angles to the mean of the normals at its ends.
    """
    rise = 0.5 * np.abs((chord * (a + b)).sum(axis=-1))
    result: NDArray[np.bool_] = ((a * b).sum(axis=-1) > MIN_FACING) & (rise < SHEET_SLOPE * length + SHEET_M)
    return result
