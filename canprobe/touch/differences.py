"""Six-unknown linear estimates from differences of points and normals: `chord` and the core of `chen1996`.

Both rest on `n_a − n_b = 2 S₃ (p_a − p_b)`, exact only where |∇f| is constant along the surface: plane, sphere,
circular cylinder. Elsewhere they keep a bias without any noise, and noise in the points, on both sides of the
equation, draws them towards 0. They are here as baselines and are reported as they are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.touch._arrays import Array, upper_root
from canprobe.touch.batch import Touches, working_frame
from canprobe.touch.estimate import Solution, SurfaceEstimate, build_estimate
from canprobe.touch.rank import decide

NO_PRIOR = "none (the method takes none)"
_COLUMNS = ((0, 1, 2), (1, 3, 4), (2, 4, 5))
"""Columns of c11 c12 c13 c22 c23 c33 in the rows of S₃ y."""
_FROM_SIX = (2, 4, 5, 0, 1, 3)
"""c13 c23 c33 c11 c12 c22 of the nine-parameter order, as places among the six."""
_NUMERIC = 1e-10
_K_TO_Q = np.outer([1.0, math.sqrt(2.0), 1.0], [1.0, math.sqrt(2.0), 1.0])


class Pairs(NamedTuple):
    """Differences along a path.

    Attributes:
        newer, older: (m,) indices of the samples.
        points: (m, 3) differences of points, in the contact frame's axes, over the extent.
        normals: (m, 3) differences of outward normals.
    """

    newer: NDArray[np.intp]
    older: NDArray[np.intp]
    points: Array
    normals: Array


def chord_pairs(touches: Touches) -> Pairs:
    """Every sample against the last."""
    n = len(touches.points)
    older = np.arange(n - 1)
    return pairs(touches, np.full(n - 1, n - 1), older)


def lag_pairs(touches: Touches, lag: int) -> Pairs:
    """Every sample against the one `lag` before it."""
    newer = np.arange(lag, len(touches.points))
    return pairs(touches, newer, newer - lag)


def pairs(touches: Touches, newer: NDArray[np.intp], older: NDArray[np.intp]) -> Pairs:
    """Differences of given samples."""
    R = working_frame(touches)[:3, :3]
    p, n = touches.points, touches.normals
    return Pairs(newer, older, (p[newer] - p[older]) @ R / touches.extent, (n[newer] - n[older]) @ R)


def three_rows(y: Array) -> Array:
    """A (3m, 6) with `A c = S₃ y` for vectors y (m, 3), (33) without its empty columns."""
    A = np.zeros((len(y), 3, 6))
    for row, columns in enumerate(_COLUMNS):
        A[:, row, columns] = y
    return A.reshape(-1, 6)


def solve_pairs(touches: Touches, data: Pairs, method: str) -> SurfaceEstimate:
    """Least squares by SVD for 2 S₃, in the contact frame of the last *measured* point and normal."""
    return estimate_from(touches, data, pseudo_inverse(three_rows(data.points)), method)


def pseudo_inverse(A: Array) -> Array:
    """A⁺ by SVD; singular values below 1e-10 of the largest are left out."""
    U, s, Vt = np.linalg.svd(A, full_matrices=False)
    kept = s > _NUMERIC * max(float(s[0]), 1e-300)
    result: Array = (Vt[kept].T / s[kept]) @ U[:, kept].T
    return result


def estimate_from(touches: Touches, data: Pairs, inverse: Array, method: str) -> SurfaceEstimate:
    """An estimate from the (6, 3m) matrix that solves for 2 (c11, c12, c13, c22, c23, c33).

    The covariance is propagated from the samples' noise; it does not know the method's bias.
    """
    length = touches.extent
    b = data.normals.reshape(-1)
    double = inverse @ b
    A = three_rows(data.points)
    residual = b - A @ double
    c = np.zeros(9)
    c[3:] = 0.5 * double[list(_FROM_SIX)]
    size = 2.0 * math.sqrt(c[6] ** 2 + 2.0 * c[7] ** 2 + c[8] ** 2)
    vp = float(touches.noise.point_variance.mean()) / length**2
    variance = float(touches.noise.normal_variance.mean()) + size**2 * vp
    k = variance * _propagated(data, inverse)[np.ix_([0, 1, 3], [0, 1, 3])]  # of 2 c11, 2 c12, 2 c22: of K itself
    flat = data.points[:, :2]
    decision = decide(_root_of(k * _K_TO_Q), flat.T @ flat / (len(flat) * 2.0 * vp), size)
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


def _propagated(data: Pairs, inverse: Array) -> Array:
    """Covariance (6, 6) of the six per unit variance of each sample's equation noise."""
    gain = inverse.reshape(6, -1, 3)
    total = np.zeros((int(data.newer.max()) + 1, 6, 3))
    np.add.at(total, data.newer, gain.transpose(1, 0, 2))
    np.subtract.at(total, data.older, gain.transpose(1, 0, 2))
    result: Array = np.einsum("kia,kja->ij", total, total)
    return result


def _root_of(covariance: Array) -> Array:
    """A root (3, 3) of the inverse of a covariance that may vanish or be singular (then: nothing is known there)."""
    values, vectors = np.linalg.eigh(covariance)
    inverse = np.where(values > 1e-14 * max(float(values[-1]), 1e-300), 1.0 / np.maximum(values, 1e-300), 0.0)
    result: Array = np.sqrt(inverse)[:, None] * vectors.T
    return result
