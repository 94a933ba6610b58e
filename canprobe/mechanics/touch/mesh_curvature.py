"""How well a fitted surface has the curvature of its mesh: measured at vertices, by what the vertices themselves show.

Vertices lie on the body. Round some of them a quartic is fitted to the nearest vertices alone; its curvature is that of
the body where the mesh shows one, and the surface is compared with it. Facets, their normals and the spacing of the
grid are not used.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from canprobe.mechanics.touch.heights import Spline
from canprobe.mechanics.types import Floats

PLACES = 300
"""Number of vertices that are looked at."""
NEIGHBOURS = (24, 60, 150)
"""Numbers of vertices that a quartic, which has 15 terms, is fitted to; that counts which leaves the least noise."""
MAX_CONDITION = 1e4
"""Largest condition of such a fit: above it the vertices lie on few lines, and show no curvature across them."""
MIN_PLACES = 20
MAX_TILT_COSINE = np.cos(np.radians(30.0))
"""Least z of the normal at a place that is compared: slopes are less exact, and the touched side is up."""
SMALL_SHARE, FLAT_PER_M = 0.01, 0.1
_POWERS = [(i, j) for i in range(5) for j in range(5 - i)]


class CurvatureError(NamedTuple):
    """Usual difference of curvature between a surface and its mesh, and the usual curvature (both RMS), 1/m.

    The tenth of the places that differs most, as edges do, does not count.
    """

    error: float
    curvature: float

    @property
    def share(self) -> float:
        """The error over the curvature."""
        return self.error / max(self.curvature, 1e-9)

    @property
    def is_small(self) -> bool:
        """Whether it is within a hundredth of the curvature, or of that of a radius of 10 m."""
        return self.error <= max(SMALL_SHARE * self.curvature, FLAT_PER_M)


class VertexCurvature(NamedTuple):
    """Principal curvatures (n, 2), larger first, 1/m, that the vertices of a mesh show at places (n, 2), m."""

    places: Floats
    kappa: Floats

    @classmethod
    def of(cls, vertices: Floats) -> VertexCurvature:
        """The curvatures at some of the vertices (k, 3), m, of the side that is seen from +z."""
        from scipy.spatial import cKDTree

        chosen, tree = vertices[:: max(1, len(vertices) // PLACES)], cKDTree(vertices)
        found = [
            _of_neighbours(vertices[tree.query(chosen, count)[1]] - chosen[:, None])
            for count in NEIGHBOURS
            if count <= len(vertices)
        ]
        if not found:
            return cls(np.empty((0, 2)), np.empty((0, 2)))
        good, kappa, _ = min(found, key=lambda one: one[2])
        return cls(chosen[good, :2], kappa)

    def against(self, spline: Spline) -> CurvatureError | None:
        """The difference to a surface; None where the vertices do not show the curvature of the body."""
        low, high = np.array(spline.corner), np.array(spline.far)
        inner = ((self.places > low + 3 * spline.spacing) & (self.places < high - 3 * spline.spacing)).all(axis=1)
        if inner.sum() < MIN_PLACES:
            return None
        bends = np.array([spline.at(x, y) for x, y in self.places[inner].tolist()]).T
        error2 = ((principal_curvatures(*bends[1:]) - self.kappa[inner]) ** 2).sum(axis=1)
        usual = error2 <= np.quantile(error2, 0.9)
        error, curvature = (float(np.sqrt(of[usual].mean())) for of in (error2, (self.kappa[inner] ** 2).sum(axis=1)))
        return CurvatureError(error, curvature)


def _of_neighbours(off: Floats) -> tuple[npt.NDArray[np.bool_], Floats, float]:
    """Places (n,) at which their neighbours (n, k, 3), m, show curvature; it (m, 2), 1/m; its usual deviation, 1/m."""
    # the deviation is by what the quartics leave over
    size = np.linalg.norm(off, axis=2).max(axis=1)
    off = off / size[:, None, None]
    _, _, axes = np.linalg.svd(off - off.mean(axis=1)[:, None], full_matrices=False)  # the plane of least squares
    axes[:, 2] *= np.where(axes[:, 2, 2:] < 0.0, -1.0, 1.0)
    x, y, z = np.moveaxis(np.einsum("nij,nkj->nki", axes, off), 2, 0)
    A = np.stack([x**i * y**j for i, j in _POWERS], axis=2)
    good = _surrounded(x, y) & (axes[:, 2, 2] > MAX_TILT_COSINE) & (np.linalg.cond(A) < MAX_CONDITION)
    if not good.any():
        return good, np.empty((0, 2)), np.inf
    A, z, size = A[good], z[good], size[good]
    inverse = np.linalg.pinv(A)
    a = np.einsum("nik,nk->ni", inverse, z)
    left2 = ((z - np.einsum("nki,ni->nk", A, a)) ** 2).sum(axis=1) / (A.shape[1] - A.shape[2])
    second = [_POWERS.index(power) for power in ((2, 0), (1, 1), (0, 2))]
    noise2 = left2 * np.square(2.0 * inverse[:, second]).sum(axis=(1, 2)) / size**2
    terms = dict(zip(_POWERS, a.T, strict=True))
    bends = 2.0 * terms[2, 0], terms[1, 1], 2.0 * terms[0, 2]
    return good, principal_curvatures(terms[1, 0], terms[0, 1], *bends) / size[:, None], float(np.median(noise2)) ** 0.5


def _surrounded(x: Floats, y: Floats) -> npt.NDArray[np.bool_]:
    """(n,) whether points (n, k) lie on all sides of their origin: none has a gap of more than 120 degrees."""
    angle = np.sort(np.arctan2(y, x), axis=1)  # the place itself has the angle 0
    gaps = np.diff(angle, axis=1, append=angle[:, :1] + 2.0 * np.pi)
    result: npt.NDArray[np.bool_] = gaps.max(axis=1) < np.radians(120.0)
    return result


def principal_curvatures(hx: Floats, hy: Floats, hxx: Floats, hxy: Floats, hyy: Floats) -> Floats:
    """(n, 2) principal curvatures of heights, positive where convex, by their slopes and second derivatives."""
    square = 1.0 + hx * hx + hy * hy
    mean = -0.5 * ((1.0 + hy * hy) * hxx - 2.0 * hx * hy * hxy + (1.0 + hx * hx) * hyy) / square**1.5
    spread = np.sqrt(np.maximum(mean * mean - (hxx * hyy - hxy * hxy) / (square * square), 0.0))
    return np.stack((mean + spread, mean - spread), axis=1)
