"""Linear estimates of six unknowns from differences of points and normals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.estimate.answer import Solution, SurfaceEstimate, build_estimate
from canprobe.mechanics.touch.estimate.likelihood import ContactBatch, working_frame
from canprobe.mechanics.touch.estimate.observed import decide
from canprobe.mechanics.touch.estimate.quadric import TO_Q, TO_Q_SQUARED, size_of
from canprobe.mechanics.touch.linear_algebra import upper_root
from canprobe.mechanics.types import Floats

NO_PRIOR = "none (the method takes none)"
_COLUMNS = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
"""Columns of c11 c12 c13 c22 c23 c33 in the rows of S₃ y."""
_FROM_SIX = [2, 4, 5, 0, 1, 3]
"""Indices among the six of c13 c23 c33 c11 c12 c22, the nine-parameter order."""
_K_OF_SIX = [0, 1, 3]
"""Indices among the six of 2 c11, 2 c12, 2 c22, which are K itself."""
_MIN_SINGULAR_SHARE = 1e-10
"""Least singular value over the largest that is used."""
_MIN_OPEN_PART = 1e-8
"""Least part of K in a unit vector of the six that the differences leave open; a smaller one is rounding."""


class Pairs(NamedTuple):
    """Differences along a path.

    Attributes:
        newer, older: (m,) indices of the samples.
        points: (m, 3) differences of points in the contact frame's axes, over the extent.
        normals: (m, 3) differences of outward normals in these axes.
    """

    newer: NDArray[np.intp]
    older: NDArray[np.intp]
    points: Floats
    normals: Floats


def pairs_of(touches: ContactBatch, lag: int | None = None) -> Pairs:
    """Differences of every sample and the one `lag` before it; None: of the last and every other."""
    older = np.arange(len(touches.points) - (lag or 1))
    newer = np.full_like(older, len(older)) if lag is None else older + lag
    p, n, R = touches.points, touches.normals, working_frame(touches)[:3, :3]
    return Pairs(newer, older, (p[newer] - p[older]) @ R / touches.extent, (n[newer] - n[older]) @ R)


def usable_lag(n: int, lag: int) -> int:
    """A lag cut to what n samples allow, at most half of them."""
    return max(1, min(lag, (n - 1) // 2))


def three_rows(y: Floats) -> Floats:
    """A (3m, 6) with `A c = S₃ y` for vectors y (m, 3), (33) without its empty columns."""
    A = np.zeros((len(y), 3, 6))
    for row, columns in enumerate(_COLUMNS):
        A[:, row, columns] = y
    return A.reshape(-1, 6)


def solve_pairs(touches: ContactBatch, data: Pairs, method: str) -> SurfaceEstimate:
    """Least squares for 2 S₃, in the contact frame of the last *measured* point and normal.

    By SVD: singular values below 1e-10 of the largest are left out, and the part of K along their vectors is not
    observed. Three points leave one combination open that mixes c33 with K. The covariance is propagated from the
    samples' noise; it does not include the method's bias.

    Source: Chen, Rink and Zhang, (30)–(35), with a pseudo-inverse instead of `(AᵀA)⁻¹`.
    """
    length = touches.extent
    A, b = three_rows(data.points), data.normals.reshape(-1)
    U, s, Vt = np.linalg.svd(A, full_matrices=len(A) < 6)  # all six of Vt, however few the rows
    rank = int(np.count_nonzero(s > _MIN_SINGULAR_SHARE * max(float(s[0]), 1e-300)))
    inverse = (Vt[:rank].T / s[:rank]) @ U[:, :rank].T
    double = inverse @ b
    residual = b - A @ double
    c = np.concatenate([np.zeros(3), 0.5 * double[_FROM_SIX]])
    size = size_of(c)
    vp = float(touches.noise.point_variance.mean()) / length**2
    variance = float(touches.noise.normal_variance.mean()) + size**2 * vp
    k = variance * _propagated(data, inverse)[np.ix_(_K_OF_SIX, _K_OF_SIX)]
    flat = data.points[:, :2]
    root_q = _root_of(k * TO_Q_SQUARED, TO_Q[:, None] * Vt[rank:, _K_OF_SIX].T)
    # a difference has the noise of two samples
    decision = decide(root_q, flat.T @ flat / (len(flat) * 2.0 * vp), size)
    return build_estimate(
        Solution(c, k, decision, has_prior=False),
        length=length,
        T_frame_contact=working_frame(touches),
        problem_root=upper_root(A),
        innovation=float(residual @ residual) / max(len(residual) - 6, 1) / (2.0 * variance),
        distance=touches.distance,
        samples=float(len(touches.points)),
        method=method,
        prior=NO_PRIOR,
    )


def _propagated(data: Pairs, inverse: Floats) -> Floats:
    """Covariance (6, 6) of the six per unit variance of each sample's equation noise."""
    gain = inverse.reshape(6, -1, 3)
    total = np.zeros((int(data.newer.max()) + 1, 6, 3))
    np.add.at(total, data.newer, gain.transpose(1, 0, 2))
    np.subtract.at(total, data.older, gain.transpose(1, 0, 2))
    result: Floats = np.einsum("kia,kja->ij", total, total)
    return result


def _root_of(covariance: Floats, open_ways: Floats) -> Floats:
    """A root (k, 3) of the inverse of a covariance that may vanish or be singular (then: nothing is known there)."""
    # nothing is known along the columns of `open_ways` (3, m) either
    ways, sizes, _ = np.linalg.svd(open_ways)
    known = ways[:, np.count_nonzero(sizes > _MIN_OPEN_PART) :]
    values, vectors = np.linalg.eigh(known.T @ covariance @ known)
    inverse = np.where(values > 1e-14 * values.max(initial=1e-300), 1.0 / np.maximum(values, 1e-300), 0.0)
    result: Floats = np.sqrt(inverse)[:, None] * (known @ vectors).T
    return result
