"""The map: nodes of all contacts, a quartic in every cell, and the one surface that they make.

A place asks the cells near it. The cells of its sheet blend with (1 − r²/ρ²)²: height, normal and curvature. The foot
is found in three steps along the blended normal. σ of the height is that of the quartics, widened where the contacts
scatter more than their noise explains, with the spread between the cells and the error of the depth by the layer's
stiffness, which is common to all places. Tool and arm displace all of the surface: σ has that, `sigma_relative` has
not. What the contacts did not observe is NaN: the height without points, the
normal of a single point, the curvature across a straight line.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from canprobe.errors import UsageError
from canprobe.mechanics.touch.checks import checked, positive, real
from canprobe.mechanics.touch.contact import HOLLOW_LIMIT_SHARE, ContactSample, at_depth, indentation_from_force
from canprobe.mechanics.touch.image.image_model import ImageModel
from canprobe.mechanics.touch.map import nodes as column
from canprobe.mechanics.touch.map.cells import Cells, LayerEvidence, solve_cells
from canprobe.mechanics.touch.map.discs import one_sheet
from canprobe.mechanics.touch.map.local_fits import CommonErrors, PadLayer
from canprobe.mechanics.touch.map.nodes import NodeGrid, Traces, rows_of
from canprobe.mechanics.touch.map.noise import MapNoise
from canprobe.mechanics.touch.map.quartic import LENGTH_M, heights_and_slopes, terms
from canprobe.mechanics.touch.map.stiffness import Stiffness
from canprobe.mechanics.touch.meshing import CELL_M, Feet, Mesh, mesh_of
from canprobe.mechanics.touch.tangent_frames import tangent_rotation
from canprobe.mechanics.types import Floats

REACH_M = 4e-3
"""Distance from the nearest contact at which the surface ends, m."""
PLACES_AT_ONCE = 4096
"""Places that are asked at once: each takes some 10 kB."""
NEAREST_CELLS = 4
"""Number of cells that a place asks."""
BLEND_M, BLEND_ROOM_M = 4.5e-3, 1.5e-3
"""Distance at which a cell ends to count, m, and by how much at least that lies beyond the nearest cell."""
FOOT_STEPS = 3
"""Steps from a place to its foot; each shrinks the error by the height over the radius of curvature."""


class MapCurvature(NamedTuple):
    """Curvature at n places; NaN where not all of it was observed.

    Attributes:
        tensor: (n, 3, 3) shape operator as a tensor in base, 1/m; positive where the body is convex.
        axes: (n, 3, 2) columns: directions x, y in the tangent plane.
        K: (n, 2, 2) the same along those axes.
        covariance: (n, 3, 3) of (K11, K12, K22), 1/m².
        rank: (n,) number of combinations of K that were observed, 0–3.
    """

    tensor: Floats
    axes: Floats
    K: Floats
    covariance: Floats
    rank: NDArray[np.intp]


class _Blend(NamedTuple):
    """What the cells near n places say; the last axis but those of vectors is that of the cells.

    `feet` hold the places on the surface, `cells` (n, k) which, `weight` their shares, `xy` (2, n, k) the feet in their
    planes, `slope_size` √(1 + |∇h|²).
    """

    feet: Feet
    cells: NDArray[np.intp]
    weight: Floats
    xy: Floats
    slope_size: Floats


class SurfaceMap:
    """A surface from contacts, one by one or many at once; it is solved when it is asked.

    Args:
        pad: the probe that made the contacts, with the stated stiffness of its layer; None: they are points, whatever
            made them.
        noise: noise of the contacts.
        image_model: calibrated model of the probe's array, for the layer's stiffness; None: without.

    Attributes:
        nodes: the contacts as nodes.
        pad, noise: as given.
    """

    def __init__(self, pad: PadLayer | None, noise: MapNoise, image_model: ImageModel | None = None) -> None:
        self.pad, self.noise = pad, noise
        self.nodes = NodeGrid(0.0 if pad is None else pad.radius, noise.lateral)
        self._evidence = LayerEvidence(image_model)
        self._traces = None if image_model is None else Traces(image_model.parameters.memory)
        self._solved: Cells | None = None

    @classmethod
    def of_nodes(cls, rows: Floats, pad: PadLayer | None, noise: MapNoise, stiffness: Stiffness | None) -> Self:
        """The map of nodes (n, COLUMNS) whose layer has a stiffness that was found before."""
        found = cls(pad, noise)
        found.nodes.put(rows)
        found._evidence.found = stiffness
        return found

    def __len__(self) -> int:
        return len(self.nodes)

    def add(self, points: ArrayLike, normals: ArrayLike, forces: ArrayLike | None = None) -> None:
        """Take contacts, one (3,) or many (n, 3), as `fit_map` does; with forces where the map has a pad.

        Raises:
            UsageError: an argument has a wrong shape or value; the message names it.
        """
        p, n = (np.atleast_2d(real(name, values)) for name, values in (("points", points), ("normals", normals)))
        p = checked("points", p, (None, 3))
        n = checked("normals", n, (len(p), 3))
        length = np.linalg.norm(n, axis=1, keepdims=True)
        if not (length > 0.0).all():
            raise UsageError(f"normals: expected directions, got one without length at index {int(length.argmin())}")
        if (forces is None) != (self.pad is None):
            raise UsageError(f"forces: expected {'none: the map has no pad' if self.pad is None else 'one a contact'}")
        rows = np.zeros((len(p), column.COLUMNS))
        rows[:, column.CENTRE], rows[:, column.NORMAL] = p, n / length
        rows[:, column.LATERAL2], rows[:, column.PATCH] = self.noise.lateral**2, math.nan
        rows[:, column.HEIGHT2], rows[:, column.NORMAL2] = self.noise.height**2, self.noise.normal**2
        if self.pad is not None:
            rows[:, column.CENTRE] += self.pad.radius * rows[:, column.NORMAL]
            rows[:, column.ROOT_FORCE] = np.sqrt(
                np.maximum(checked("forces", np.ravel(real("forces", forces)), (len(p),)), 0.0)
            )
        self._add(rows)

    def _add(self, rows: Floats) -> None:
        if len(rows):
            self.nodes.add(rows)
            self._solved = None

    def add_samples(self, samples: Sequence[ContactSample]) -> None:
        """Take contacts of the pad, in the order of time.

        Raises:
            UsageError: the map has no pad.
        """
        if self.pad is None:
            raise UsageError("samples: expected a map of a pad, got one of points; use add(points, normals)")
        if samples and self._evidence.touch is None and samples[0].slope is not None:
            self._evidence.touch = samples[0].slope, samples[0].p_base
        self._add(rows_of(samples, self.pad.radius, self.noise, self._traces))

    def settled(self, samples: Sequence[ContactSample]) -> list[ContactSample]:
        """Contacts of the pad with the depth that stiffness and curvature of the map give them.

        Where the map did not observe all of the curvature contacts stay as they are.
        """
        if self.pad is None or not samples or not len(self.nodes):
            return list(samples)
        K = self.curvature(np.array([sample.p_base for sample in samples])).K
        known = np.flatnonzero(np.isfinite(K[:, 0, 0]))
        kappa = np.maximum(np.linalg.eigvalsh(K[known]), -HOLLOW_LIMIT_SHARE / self.pad.radius)
        found = list(samples)
        stiffness = self.solved().stiffness
        assert stiffness is not None
        for i, of_place in zip(known.tolist(), kappa, strict=True):
            depth = indentation_from_force(samples[i].force_n, stiffness.value, self.pad.radius, of_place)
            found[i] = at_depth(samples[i], depth, self.pad.radius)
        return found

    def closest(self, points: ArrayLike) -> Feet:
        """The points of the surface that are closest to given points (n, 3), m; NaN beyond reach of the contacts."""
        return Feet(*self._answers(lambda blend: blend.feet, points))

    def distance(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """Signed distances (n,) of points (n, 3) from the surface, m, positive outside, and their σ (n,), m."""
        feet = self.closest(points)
        return feet.height, feet.sigma

    def normal(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """Outward unit normals (n, 3) at the feet of points (n, 3), m, and their covariances (n, 3, 3), rad²."""
        normal, covariance = self._answers(self._normal, points)
        return normal, covariance

    def _normal(self, blend: _Blend) -> tuple[Floats, Floats]:
        cells, R = self.solved(), self.solved().discs.R[blend.cells]
        rows = np.stack(terms(*blend.xy, (1, 0), (0, 1)), axis=-2)
        V = rows @ cells.covariance[blend.cells] @ np.swapaxes(rows, -1, -2) / blend.slope_size[..., None, None] ** 2
        V = np.einsum("nk,nkip,nkpq,nkjq->nij", blend.weight, R[..., :2], V, R[..., :2])
        return blend.feet.normal, V + 0.0 * blend.feet.normal[:, :1, None]  # NaN where the normal is

    def curvature(self, points: ArrayLike) -> MapCurvature:
        """Curvature at the feet of points (n, 3), m."""
        return MapCurvature(*self._answers(self._curvature, points))

    def _curvature(self, blend: _Blend) -> MapCurvature:
        cells, n = self.solved(), blend.feet.normal
        axes = np.array([tangent_rotation(one)[:, :2] for one in n.tolist()]).reshape(-1, 3, 2)
        # the axes of a cell turned into those of the place: K' = Q K Qᵀ, written for (K11, K12, K22)
        Q = np.einsum("nip,nkiq->nkpq", axes, cells.discs.R[blend.cells][..., :2])
        (p, q), (r, s) = np.moveaxis(Q, (-2, -1), (0, 1))
        turn = np.stack([p * p, 2 * p * q, q * q, p * r, p * s + q * r, q * s, r * r, 2 * r * s, s * s], axis=-1)
        second = np.stack(terms(*blend.xy, (2, 0), (1, 1), (0, 2)), axis=-2) / blend.slope_size[..., None, None]
        rows = turn.reshape(*p.shape, 3, 3) @ second / -LENGTH_M
        seen = blend.weight * cells.known[blend.cells, 2]
        total = seen.sum(axis=1)
        with np.errstate(invalid="ignore"):
            share = seen / total[:, None]
        K = np.einsum("nk,nkpi,nki->np", share, rows, cells.fits.a[blend.cells])[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        V = np.einsum("nk,nkip,nkpq,nkjq->nij", share, rows, cells.covariance[blend.cells], rows, optimize=True)
        tensor = np.einsum("nip,npq,njq->nij", axes, K, axes)
        rank = np.where(np.isfinite(n[:, 0]), cells.rank[blend.cells[:, 0]], 0)
        return MapCurvature(tensor, axes, K, V, np.where(total > 0.0, 3, np.minimum(rank, 2)))

    def disagreement(self, points: ArrayLike) -> Floats:
        """(n,) χ² per degree of freedom, above 1, of the contacts near points (n, 3), m: 0 where all passes agree.

        All passes over a place share one quartic and the scan's common errors. What is left over beyond the noise is
        where they show different surfaces, or one that is rougher than the pad can follow.
        """
        (excess,) = self._answers(self._disagreement, points)
        return excess

    def _disagreement(self, blend: _Blend) -> tuple[Floats]:
        excess: Floats = np.einsum("nk,nk->n", blend.weight, self.solved().fits.excess[blend.cells])
        return (excess + 0.0 * blend.feet.normal[:, 0],)  # NaN out of reach

    def mesh(self, *, cell: float = CELL_M) -> Mesh:
        """The surface as triangles with its σ at every vertex; cells of the lattice have a side `cell`, m.

        Raises:
            UsageError: `cell` is not positive, or too small for the size of the coordinates.
        """
        return mesh_of(self.closest, self.points, positive("cell", cell))

    @property
    def points(self) -> Floats:
        """(n, 3) contact points of the nodes, m, with the layer unsqueezed."""
        return self.nodes.points_of(self.nodes.rows)

    @property
    def normals(self) -> Floats:
        """(n, 3) outward unit normals of the nodes."""
        return self.nodes.rows[:, column.NORMAL]

    @property
    def common(self) -> CommonErrors:
        """Errors that the whole scan has in common."""
        return self.solved().common

    @property
    def stiffness(self) -> Stiffness | None:
        """Stiffness of the pad's layer that the whole scan shows; None without a pad."""
        return self.solved().stiffness

    def solved(self) -> Cells:
        """The cells; they are solved where contacts came since.

        Raises:
            UsageError: there are no contacts.
        """
        if not len(self.nodes):
            raise UsageError("map: expected contacts, got none yet; add some first")
        if self._solved is None:
            self._solved = solve_cells(self.nodes.rows, self.points, self.pad, self.noise, self._evidence)
        return self._solved

    def _answers(self, answer: Callable[[_Blend], Sequence[NDArray[Any]]], points: ArrayLike) -> list[NDArray[Any]]:
        """The columns that an answer has for points (n, 3), of some places after the other: memory stays bounded."""
        q = checked("points", points, (None, 3))
        # without a place there is one empty part, whose columns have their shapes
        starts = range(0, max(len(q), 1), PLACES_AT_ONCE)
        parts = [answer(self._blend(q[i : i + PLACES_AT_ONCE])) for i in starts]
        return [np.concatenate(column) for column in zip(*parts, strict=True)]

    def _blend(self, q: Floats) -> _Blend:
        """What the cells say of points (n, 3), m."""
        cells = self.solved()
        discs, count = cells.discs, min(NEAREST_CELLS, len(cells.discs.origin))
        which = cells.tree.query(q, range(1, count + 1))[1].reshape(-1, count)
        R, origin, a = discs.R[which], discs.origin[which], np.moveaxis(cells.fits.a[which], -1, 0).copy()

        def over(foot: Floats) -> tuple[Floats, Floats, Floats, Floats]:
            """Height above each quartic, its normal, the foot in its plane, and √(1 + |∇h|²)."""
            x, y, z = np.moveaxis(((foot[:, None] - origin)[..., None, :] @ R)[..., 0, :], -1, 0) / LENGTH_M
            h, hx, hy = heights_and_slopes(a, x, y)
            size = np.sqrt(1.0 + hx * hx + hy * hy)
            up = (R @ (np.stack([-hx, -hy, np.ones_like(hx)], axis=-1) / size[..., None])[..., None])[..., 0]
            return (z - h) * LENGTH_M / size, up, np.stack([x, y]), size

        height, up, xy, size = over(q)
        away = np.linalg.norm(q[:, None] - origin, axis=-1)
        # the sheet of the place: that of the cell whose quartic is nearest, and of two the one that is nearer itself
        first = np.argmin(np.abs(height) + 0.1 * away, axis=1)[:, None]
        main = np.take_along_axis(which, first, axis=1)
        chord = origin - discs.origin[main]
        same = one_sheet(chord, np.linalg.norm(chord, axis=-1), R[..., 2], discs.R[main][..., 2])
        normal = np.take_along_axis(up, first[..., None], axis=1)[:, 0]
        foot = q - np.take_along_axis(height, first, axis=1) * normal
        known = same & cells.known[which, 1]
        for _ in range(FOOT_STEPS):
            height, up, xy, size = over(foot)
            r = np.linalg.norm(foot[:, None] - origin, axis=-1)
            nearest = np.where(known, r, math.inf).min(axis=1, keepdims=True)
            weight = np.maximum(1.0 - (r / np.maximum(BLEND_M, nearest + BLEND_ROOM_M)) ** 2, 0.0) ** 2 * known
            with np.errstate(invalid="ignore"):
                weight = weight / weight.sum(axis=1, keepdims=True)
            normal = np.einsum("nk,nki->ni", weight, up)
            normal = normal / np.sqrt((normal * normal).sum(axis=1, keepdims=True))
            apart = height / np.maximum((up * normal[:, None]).sum(axis=-1), 0.5)
            above = ((q - foot) * normal).sum(axis=1) + (weight * apart).sum(axis=1)
            foot = q - above[:, None] * normal
        (f,) = terms(*xy, (0, 0))
        variance = ((f[..., None, :] @ cells.covariance[which])[..., 0, :] * f).sum(axis=-1) * LENGTH_M**2 / size**2
        variance += cells.height2[which]
        spread = apart - (weight * apart).sum(axis=1, keepdims=True)
        sigma = np.sqrt((weight * (variance + spread**2)).sum(axis=1))
        finite: NDArray[np.bool_] = np.isfinite(foot[:, 0])
        apart_from: Floats = np.asarray(cells.contacts.query(np.where(finite[:, None], foot, 0.0))[0])
        reached: NDArray[np.bool_] = (apart_from < REACH_M) & finite
        nowhere = np.where(reached, 0.0, math.nan)
        floating = np.where((weight * cells.known[which, 0]).sum(axis=1) > 0.0, nowhere, math.nan)  # normals alone
        feet = Feet(
            foot + floating[:, None],
            normal + nowhere[:, None],
            above + floating,
            np.hypot(sigma, self.noise.place) + floating,
            sigma + floating,
        )
        return _Blend(feet, which, np.where(reached[:, None], weight, 0.0), xy, size)
