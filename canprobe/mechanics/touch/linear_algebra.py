"""Small matrices, as all of touch uses them.

LAPACK is called by its own names: on matrices as small as these, numpy's wrappers cost four times the decomposition.
For the same reason what runs in the loop says `A.dot(B)`, which costs half of `A @ B`, and works on single vectors
and 2x2 matrices in plain floats.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg.lapack import dgeqrf, dgesv, dpotrf, dsyev, dtrtri

from canprobe.mechanics.types import Floats

_UPPER, _IDENTITY = np.triu(np.ones((16, 16))), np.eye(16)


def rms(values: Floats) -> float:
    """Root of the mean square; NaN where there is no value."""
    return math.sqrt(float(np.mean(np.square(values)))) if len(values) else math.nan


def upper_root(A: Floats) -> Floats:
    """The upper triangular R of a QR decomposition, Rᵀ R = Aᵀ A."""
    qr, _, _, _ = dgeqrf(A)
    R = qr[: min(A.shape)]
    n, m = R.shape
    return R * _UPPER[:n, :m] if m <= len(_UPPER) else np.triu(R)


def solved(A: Floats, B: Floats) -> Floats:
    """A⁻¹ B; numpy's LinAlgError where A is singular."""
    X: Floats
    _, _, X, info = dgesv(A, B)
    if info > 0:
        raise np.linalg.LinAlgError("singular matrix")
    return X


def inverted(A: Floats) -> Floats:
    """A⁻¹; numpy's LinAlgError where A is singular."""
    n = len(A)
    return solved(A, _IDENTITY[:n, :n] if n <= len(_IDENTITY) else np.eye(n))


def inverted_upper(R: Floats) -> Floats:
    """R⁻¹ of an upper triangular R; numpy's LinAlgError where it is singular."""
    result: Floats
    result, info = dtrtri(R)
    if info > 0:
        raise np.linalg.LinAlgError("singular matrix")
    return result


def eigen(A: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues of a symmetric matrix, the least first, and eigenvectors as columns; LinAlgError if not finite."""
    values, vectors, info = dsyev(A, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError("eigenvalues did not converge")
    return values, vectors


def principal(A: Floats) -> tuple[float, float, float]:
    """Mean and half difference of the eigenvalues of a symmetric (2, 2), and the angle (rad) of the larger one."""
    (a, b), (_, d) = A.tolist()
    return principal_of(a, b, d)


def principal_of(a: float, b: float, d: float) -> tuple[float, float, float]:
    """As `principal`, for the matrix [[a, b], [b, d]] in plain floats."""
    half = 0.5 * (a - d)
    return 0.5 * (a + d), math.hypot(half, b), 0.5 * math.atan2(b, half)


def lower_root(A: Floats) -> Floats:
    """The lower triangular L of a Cholesky decomposition, L Lᵀ = A; LinAlgError where A is not positive definite."""
    L: Floats
    L, info = dpotrf(A, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError("matrix is not positive definite")
    return L
