"""Array types and input checks that the touch modules share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dgeqrf, dgesv, dpotrf, dsyev, dtrtri

from canprobe.errors import UsageError

Array = NDArray[np.float64]
_UPPER = np.triu(np.ones((16, 16)))

# LAPACK is called by its own names: on matrices as small as these, numpy's wrappers cost four times the decomposition.


def upper_root(A: Array) -> Array:
    """The upper triangular R of a QR decomposition, Rᵀ R = Aᵀ A."""
    qr, _, _, _ = dgeqrf(A)
    R = qr[: min(A.shape)]
    n, m = R.shape
    return R * _UPPER[:n, :m] if m <= len(_UPPER) else np.triu(R)


def solved(A: Array, B: Array) -> Array:
    """A⁻¹ B.

    Raises:
        numpy.linalg.LinAlgError: where A is singular.
    """
    _, _, X, info = dgesv(A, B)
    if info > 0:
        raise np.linalg.LinAlgError("singular matrix")
    result: Array = X
    return result


def inverted(A: Array) -> Array:
    """A⁻¹.

    Raises:
        numpy.linalg.LinAlgError: where A is singular.
    """
    return solved(A, np.eye(len(A)))


def inverted_upper(R: Array) -> Array:
    """R⁻¹ of an upper triangular R.

    Raises:
        numpy.linalg.LinAlgError: where R is singular.
    """
    result, info = dtrtri(R)
    if info > 0:
        raise np.linalg.LinAlgError("singular matrix")
    found: Array = result
    return found


def eigen(A: Array) -> tuple[Array, Array]:
    """Eigenvalues of a symmetric matrix, the least first, and its eigenvectors as columns.

    Raises:
        numpy.linalg.LinAlgError: where it is not finite.
    """
    values, vectors, info = dsyev(A, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError("eigenvalues did not converge")
    return values, vectors


def lower_root(A: Array) -> Array:
    """The lower triangular L of a Cholesky decomposition, L Lᵀ = A.

    Raises:
        numpy.linalg.LinAlgError: where A is not positive definite.
    """
    L, info = dpotrf(A, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError("matrix is not positive definite")
    result: Array = L
    return result


def read_only(values: ArrayLike) -> Array:
    """A private copy that nobody can write to."""
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array


def checked(name: str, values: ArrayLike, shape: Sequence[int | None]) -> Array:
    """Values as floats of the wanted shape, all finite.

    Args:
        name: the field, for the message.
        values: what the caller gave.
        shape: expected shape; None stands for any length.

    Raises:
        UsageError: naming the field, what was expected and what was got.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{name}: expected numbers of shape {_spell(shape)}, got {values!r}") from error
    if len(array.shape) != len(shape) or any(e is not None and e != g for e, g in zip(shape, array.shape, strict=True)):
        raise UsageError(f"{name}: expected shape {_spell(shape)}, got {array.shape}")
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        raise UsageError(f"{name}: expected numbers, got masked ones; leave those rows out")
    if not np.isfinite(array).all():
        first = np.argwhere(~np.isfinite(array))[0].tolist()
        raise UsageError(f"{name}: expected finite numbers, got {array[tuple(first)]} at index {first}")
    return array


def positive(name: str, value: Any) -> float:
    """A finite number above zero.

    Raises:
        UsageError: naming the field, what was expected and what was got.
    """
    number = float(checked(name, value, ()))
    if not number > 0.0:
        raise UsageError(f"{name}: expected a number above 0, got {number}")
    return number


def _spell(shape: Sequence[int | None]) -> str:
    return (
        "(" + ", ".join("n" if side is None else str(side) for side in shape) + ("," if len(shape) == 1 else "") + ")"
    )
