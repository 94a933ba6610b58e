"""Small matrices and input checks, as all of touch uses them.

LAPACK is called by its own names: on matrices as small as these, numpy's wrappers cost four times the decomposition.
For the same reason what runs in the loop says `A.dot(B)`, which costs half of `A @ B`, and works on single vectors
and 2x2 matrices in plain floats.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dgeqrf, dgesv, dpotrf, dsyev, dtrtri

from canprobe.errors import UsageError
from canprobe.mechanics.types import Floats

_T = TypeVar("_T")
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


def read_only(values: ArrayLike) -> Floats:
    """A copy that cannot be written to."""
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array


def real_numbers(values: Any) -> Floats:
    """Values as floats.

    Raises:
        TypeError, ValueError: a value is not a real number (text, a complex number), or rows differ in length.
    """
    found = np.asarray(values)
    texts = found.dtype == object and any(isinstance(value, str | bytes) for value in found.flat)
    if texts or found.dtype.kind not in "biufO":
        raise TypeError(f"expected real numbers, got {found.dtype}")
    try:
        return np.asarray(found, dtype=np.float64)
    except OverflowError as error:
        raise ValueError(str(error)) from error


def real(name: str, values: Any, form: str = "") -> Floats:
    """Values as floats, of any shape, NaN allowed; else a UsageError that names the field."""
    try:
        return real_numbers(values)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{name}: expected real numbers{form}, got {values!r}") from error


MAX_MAGNITUDE = 1e60
"""Largest size of an input, in any unit: products of five of them stay finite."""
MAX_LENGTH = 1e12
"""Largest coordinate or standard deviation, in any unit: beyond it an estimate would be rounding error."""


def checked(name: str, values: Any, shape: Sequence[int | None]) -> Floats:
    """Values as floats of a shape (None: any length), all finite; else a UsageError that names the field."""
    if isinstance(values, np.ma.MaskedArray) and np.ma.is_masked(values):
        raise UsageError(f"{name}: expected numbers, got masked ones; leave those rows out")
    array = real(name, values, f" of shape {_spell(shape)}")
    if len(array.shape) != len(shape) or any(e is not None and e != g for e, g in zip(shape, array.shape, strict=True)):
        raise UsageError(f"{name}: expected shape {_spell(shape)}, got {array.shape}")
    within = np.abs(array) <= MAX_MAGNITUDE
    if not within.all():
        first = np.argwhere(~within)[0].tolist()
        wanted = f"finite numbers, at most {MAX_MAGNITUDE:g} in size"
        raise UsageError(f"{name}: expected {wanted}, got {array[tuple(first)]} at index {first}")
    return array


def positive(name: str, value: Any) -> float:
    """A finite number above zero; else a UsageError that names the field."""
    number = float(checked(name, value, ()))
    if not number > 0.0:
        raise UsageError(f"{name}: expected a number above 0, got {number}")
    return number


def whole(name: str, value: Any, least: int, unit: str) -> int:
    """A whole number, not below `least`; else a UsageError that names the field."""
    number = float(checked(name, value, ()))
    if number < least or number != int(number):
        raise UsageError(f"{name}: expected at least {least} {unit}, a whole number of them, got {value!r}")
    return int(number)


def instance(name: str, value: Any, kind: type[_T]) -> _T:
    """A value of a class; else a UsageError that names the field."""
    if not isinstance(value, kind):
        raise UsageError(f"{name}: expected a {kind.__name__}, got {value!r}")
    return value


def _spell(shape: Sequence[int | None]) -> str:
    sides = ", ".join("n" if side is None else str(side) for side in shape)
    return f"({sides},)" if len(shape) == 1 else f"({sides})"
