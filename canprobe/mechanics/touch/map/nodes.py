"""Nodes: contacts averaged over a millimetre of path, in a hash grid.

A node is the mean of the contacts along a millimetre of the way that the contact has really made (`PathLength`: noise
at rest makes no way). A node that falls into the voxel of an older one with the same facing is averaged with it: ground
that is scanned again adds weight and hardly any memory.

The mean of points on an arc lies beside it, inside a convex body, by some µm over a millimetre: by half the mean of
Δp·Δn, with points p and normals n about their means. A node is lifted by that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.contact import ContactSample, direction_to_pad
from canprobe.mechanics.touch.estimate.path_length import PathLength
from canprobe.mechanics.touch.image.moments import PadMemory, overlapping
from canprobe.mechanics.touch.map.noise import MapNoise
from canprobe.mechanics.types import Floats

NODE_M = 1e-3
"""Path of a node, and side of a voxel, m; a single touch counts as one path of this length."""
BLOCK_M = 12e-3
"""Side of a block of nodes that are found together, m: the largest radius of a local fit."""
JUMP_M = 2e-3
"""Distance from one contact to the next that is a new touch, m."""
PATH_STEPS_PER_SIGMA = 4.0
"""Least step of `PathLength`, in standard deviations of the point."""
CENTRE, NORMAL, X_PAD, Y_PAD, Z_PAD, HEADING = (slice(3 * i, 3 * i + 3) for i in range(6))
ROOT_FORCE, LATERAL2, HEIGHT2, NORMAL2, PATCH = range(18, 23)
COUNT, PATH = 23, 24
COLUMNS = 25
"""Columns of a node: probe centre, outward normal, axes of the pad, heading, √force (√N), variances of the lateral
error (m²), of the height (m²), of the normal (rad²), √det of the patch's second moments (m², NaN without an image);
number of contacts, path (m)."""
_MEANS = slice(0, COUNT)


def step_of(sigma_point: float) -> float:
    """Least step of the path of contacts with a standard deviation (m), m."""
    return min(PATH_STEPS_PER_SIGMA * sigma_point, 0.5 * NODE_M)


class NodeGrid:
    """Nodes of all contacts so far.

    Args:
        radius: radius of the probe, m; 0 where centres are contact points.
        sigma_point: usual standard deviation of a contact, m.
    """

    def __init__(self, radius: float, sigma_point: float) -> None:
        self._radius = radius
        self._step = step_of(sigma_point)
        self._rows = np.zeros((64, COLUMNS))
        self._size = 0
        self._numbers: dict[tuple[int, ...], int] = {}
        self._blocks: dict[tuple[int, ...], list[int]] = {}
        self._path_length, self._begun_at = PathLength(self._step), 0.0
        self._open = np.zeros(COLUMNS)
        self._along_normals = 0.0  # sum of p·n of the open node, m
        self._first = self._last = np.zeros(3)

    def __len__(self) -> int:
        return self._size + int(self._open[COUNT] > 0.0)

    def add(self, rows: Floats) -> None:
        """Take contacts (n, COLUMNS), in the order of time; their number and path are set here."""
        for row, point in zip(rows, self.points_of(rows), strict=True):
            if not self._open[COUNT]:
                self._first = point
            elif math.dist(point.tolist(), self._last.tolist()) > JUMP_M:
                self._close()
                self._path_length, self._begun_at, self._first = PathLength(self._step), 0.0, point
            self._last = point
            self._open[_MEANS] += row[_MEANS]
            self._open[COUNT] += 1.0
            self._along_normals += float(point @ row[NORMAL])
            self._path_length.add(point)
            if self._path_length.total - self._begun_at >= NODE_M:
                self._close()

    def put(self, rows: Floats) -> None:
        """Take nodes (n, COLUMNS) as they are."""
        for row in rows:
            self._numbers.setdefault(self._voxel(row), self._size)
            self._append(row)

    def _append(self, row: Floats) -> None:
        if self._size == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self._size] = row
        self._blocks.setdefault(_block(self.points_of(row)), []).append(self._size)
        self._size += 1

    def _close(self) -> None:
        """Put the open node into its voxel."""
        row = self._finished()
        number = self._numbers.setdefault(self._voxel(row), self._size)
        if number < self._size:
            old = self._rows[number]
            share = row[PATH] / (row[PATH] + old[PATH])
            bent = float((self.points_of(row) - self.points_of(old)) @ (row[NORMAL] - old[NORMAL]))
            old[_MEANS] = (1.0 - share) * old[_MEANS] + share * row[_MEANS]  # variances may be infinite
            old[COUNT:] += row[COUNT:]
            self._lift(old, share * (1.0 - share) * bent)
        else:
            self._append(row)
        self._open, self._along_normals = np.zeros(COLUMNS), 0.0
        self._begun_at = self._path_length.total

    def _finished(self) -> Floats:
        """The open node as a mean."""
        count = self._open[COUNT]
        row: Floats = self._open / count
        row[COUNT], row[PATH] = count, max(self._path_length.total - self._begun_at, NODE_M)
        self._lift(row, self._along_normals / count - float(self.points_of(row) @ row[NORMAL]))
        way = self._last - self._first
        # less than a unit vector at rest, where the direction of the way is noise
        row[HEADING] = way / max(float(np.linalg.norm(way)), 0.5 * NODE_M)
        return row

    def _lift(self, row: Floats, bent: float) -> None:
        """Turn means of contacts with a mean Δp·Δn (m) into a node: on the surface, with a unit normal."""
        if math.isinf(row[NORMAL2]):
            bent = 0.0  # such normals only say on which side the body is
        point = self.points_of(row)
        row[NORMAL] /= np.linalg.norm(row[NORMAL])
        row[CENTRE] = point + (self._radius + 0.5 * bent) * row[NORMAL]

    def _voxel(self, row: Floats) -> tuple[int, ...]:
        return (*np.floor(self.points_of(row) / NODE_M).astype(int).tolist(), facing(row[None, NORMAL])[0])

    def points_of(self, row: Floats) -> Floats:
        """Contact points (…, 3) of rows (…, COLUMNS), m, with the layer unsqueezed."""
        return row[..., CENTRE] - self._radius * row[..., NORMAL]

    def near(self, place: Floats) -> Floats:
        """(n, COLUMNS) the closed nodes in the blocks round a place (3,), m: all within `BLOCK_M`, and some beyond."""
        i, j, k = _block(place)
        around = ((i + a, j + b, k + c) for a in (-1, 0, 1) for b in (-1, 0, 1) for c in (-1, 0, 1))
        return self._rows[[number for block in around for number in self._blocks.get(block, ())]]

    @property
    def rows(self) -> Floats:
        """(n, COLUMNS) every node, the open one last."""
        closed = self._rows[: self._size]
        return np.concatenate([closed, self._finished()[None]]) if self._open[COUNT] > 0.0 else closed.copy()


def _block(point: Floats) -> tuple[int, ...]:
    return tuple(np.floor(point / BLOCK_M).astype(int).tolist())


class Traces:
    """Sizes of patches in images that show traces of where the patch was before (`PadMemory`).

    Args:
        share: share of those traces in the moments (`ImageParameters.memory`).
    """

    def __init__(self, share: float) -> None:
        self._share, self._memory = share, PadMemory()

    def size_of(self, sample: ContactSample, radius: float) -> float:
        """√det of the second moments of a contact's patch, m², NaN without an image; samples in the order of time."""
        x, y, z = sample.r_probe.tolist()
        reach = math.sqrt(x * x + y * y + z * z)
        was = self._memory.add(sample.t_s, *direction_to_pad((x / reach, y / reach, z / reach), radius))
        if sample.moments is None:
            return math.nan
        shown = overlapping(was, sample.moments)
        uu, uv, vv = (now - self._share * trace for now, trace in zip(sample.moments, shown, strict=True))
        return math.sqrt(max(uu * vv - uv * uv, 0.0))


def rows_of(samples: Sequence[ContactSample], radius: float, noise: MapNoise, traces: Traces | None) -> Floats:
    """Contacts of a pad as rows (n, COLUMNS).

    Args:
        samples: contacts in the order of time.
        radius: radius of the probe, m.
        noise: noise of the map.
        traces: traces of earlier places of the patch in its images; they go on with these contacts.
    """
    rows = np.zeros((len(samples), COLUMNS))
    T = np.array([sample.T_base_probe for sample in samples]).reshape(-1, 4, 4)
    rows[:, CENTRE], rows[:, X_PAD], rows[:, Y_PAD], rows[:, Z_PAD] = T[:, :3, 3], T[:, :3, 0], T[:, :3, 1], T[:, :3, 2]
    rows[:, NORMAL] = np.array([sample.n_base for sample in samples]).reshape(-1, 3)
    rows[:, NORMAL2], rows[:, PATCH] = noise.normal**2, math.nan
    for row, sample in zip(rows, samples, strict=True):
        row[ROOT_FORCE] = math.sqrt(max(sample.force_n, 0.0))
        row[LATERAL2], row[HEIGHT2] = noise.lateral2(sample), noise.height2(sample)
        if traces is not None:
            row[PATCH] = traces.size_of(sample, radius)
    return rows


def facing(normals: Floats) -> NDArray[np.intp]:
    """(n,) the axis, 0–5, that a normal (n, 3) points along most: x, y, z, −x, −y, −z."""
    axis: NDArray[np.intp] = np.abs(normals).argmax(axis=1)
    return axis + np.where(np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0.0, 3, 0)
