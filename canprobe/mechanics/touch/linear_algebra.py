"""Small matrices, input checks, and frames on a tangent plane, as all of touch uses them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg.lapack import dgeqrf, dgesv, dpotrf, dsyev, dtrtri

from canprobe.errors import UsageError

Array = NDArray[np.float64]
Vec = tuple[float, float, float]
_T = TypeVar("_T")
_UPPER, _IDENTITY = np.triu(np.ones((16, 16))), np.eye(16)

# LAPACK is called by its own names: on matrices as small as these, numpy's wrappers cost four times the decomposition.
# For the same reason what runs in the loop says `A.dot(B)`, which costs half of `A @ B`, and works on single vectors
# and 2x2 matrices in plain floats.


def upper_root(A: Array) -> Array:
    """The upper triangular R of a QR decomposition, Rᵀ R = Aᵀ A."""
    qr, _, _, _ = dgeqrf(A)
    R = qr[: min(A.shape)]
    n, m = R.shape
    return R * _UPPER[:n, :m] if m <= len(_UPPER) else np.triu(R)


def solved(A: Array, B: Array) -> Array:
    """A⁻¹ B; numpy's LinAlgError where A is singular."""
    X: Array
    _, _, X, info = dgesv(A, B)
    if info > 0:
        raise np.linalg.LinAlgError("singular matrix")
    return X


def inverted(A: Array) -> Array:
    """A⁻¹; numpy's LinAlgError where A is singular."""
    n = len(A)
    return solved(A, _IDENTITY[:n, :n] if n <= len(_IDENTITY) else np.eye(n))


def inverted_upper(R: Array) -> Array:
    """R⁻¹ of an upper triangular R; numpy's LinAlgError where it is singular."""
    result: Array
    result, info = dtrtri(R)
    if info > 0:
        raise np.linalg.LinAlgError("singular matrix")
    return result


def eigen(A: Array) -> tuple[Array, Array]:
    """Eigenvalues of a symmetric matrix, the least first, and eigenvectors as columns; LinAlgError if not finite."""
    values, vectors, info = dsyev(A, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError("eigenvalues did not converge")
    return values, vectors


def principal(A: Array) -> tuple[float, float, float]:
    """Mean and half difference of the eigenvalues of a symmetric (2, 2), and the angle (rad) of the larger one."""
    (a, b), (_, d) = A.tolist()
    return principal_of(a, b, d)


def principal_of(a: float, b: float, d: float) -> tuple[float, float, float]:
    """The same of the matrix a, b; b, d."""
    half = 0.5 * (a - d)
    return 0.5 * (a + d), math.hypot(half, b), 0.5 * math.atan2(b, half)


def lower_root(A: Array) -> Array:
    """The lower triangular L of a Cholesky decomposition, L Lᵀ = A; LinAlgError where A is not positive definite."""
    L: Array
    L, info = dpotrf(A, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError("matrix is not positive definite")
    return L


def read_only(values: ArrayLike) -> Array:
    """A private copy that nobody can write to."""
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array


def real_numbers(values: Any) -> Array:
    """Values as floats.

    Raises:
        TypeError, ValueError: one is no real number, as text and complex numbers are not; or rows differ in length.
    """
    found = np.asarray(values)
    texts = found.dtype == object and any(isinstance(value, str | bytes) for value in found.flat)
    if texts or found.dtype.kind not in "biufO":
        raise TypeError(f"expected real numbers, got {found.dtype}")
    try:
        return np.asarray(found, dtype=np.float64)
    except OverflowError as error:
        raise ValueError(str(error)) from error


def real(name: str, values: Any, form: str = "") -> Array:
    """Values as floats, of any shape and also NaN; else a UsageError that names the field."""
    try:
        return real_numbers(values)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{name}: expected real numbers{form}, got {values!r}") from error


MAX_MAGNITUDE = 1e60
"""Of numbers, in any unit: products of five of them are still numbers."""
MAX_LENGTH = 1e12
"""Of points and standard deviations, in any unit: beyond, an estimate would be rounding."""


def checked(name: str, values: Any, shape: Sequence[int | None]) -> Array:
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


# Frames on a tangent plane, and small rotations.

_AXIS_LIMIT = 0.95
"""Above this |component| of the normal the frame's own x axis is too close to it, and y is used."""


def tangent_rotation(z_axis: Sequence[float] | Array) -> Array:
    """Right-handed axes (3, 3), columns x, y, z, with a given unit z; x is the parent frame's x on the tangent plane.

    Where z is within 18° of the parent's x axis, the parent's y axis is laid on the plane instead. The choice depends
    on z alone, so that two nearly equal normals give nearly equal axes.
    """
    zx, zy, zz = float(z_axis[0]), float(z_axis[1]), float(z_axis[2])
    if abs(zx) <= _AXIS_LIMIT:
        scale = 1.0 / math.sqrt(max(zy * zy + zz * zz, 1e-300))
        xx, xy, xz = (zy * zy + zz * zz) * scale, -zx * zy * scale, -zx * zz * scale
    else:
        scale = 1.0 / math.sqrt(zx * zx + zz * zz)
        xx, xy, xz = -zy * zx * scale, (zx * zx + zz * zz) * scale, -zy * zz * scale
    return np.array([[xx, zy * xz - zz * xy, zx], [xy, zz * xx - zx * xz, zy], [xz, zx * xy - zy * xx, zz]])


def transported(x_axis: Vec, z_axis: Vec) -> tuple[Vec, Vec]:
    """Axes x and y, turned the shortest way so that their z becomes a unit vector: parallel transport over a step."""
    x, y, z = x_axis
    u, v, w = z_axis
    along = x * u + y * v + z * w
    x, y, z = x - along * u, y - along * v, z - along * w
    size = math.sqrt(x * x + y * y + z * z)
    if size < 1e-6:
        first, second, _ = tangent_rotation(z_axis).T.tolist()
        return first, second
    x, y, z = x / size, y / size, z / size
    return (x, y, z), (v * z - w * y, w * x - u * z, u * y - v * x)


def homogeneous(R: Array, origin: Sequence[float] | Array) -> Array:
    """The 4x4 matrix of a rotation and an origin."""
    T = np.zeros((4, 4))
    T[:3, :3] = R
    T[:3, 3] = origin
    T[3, 3] = 1.0
    return T


def inverse_transform(T: Array) -> Array:
    """The inverse of a rigid 4x4 transform."""
    R = T[:3, :3].T
    return homogeneous(R, -R @ T[:3, 3])


def rotation_vectors(R: Array) -> Array:
    """The rotation vectors (n, 3) (angle times axis, rad) of rotations (n, 3, 3) below a half turn."""
    w = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = 0.5 * np.linalg.norm(w, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(R, axis1=1, axis2=2) - 1.0))
    small = sine < 1e-12
    return np.asarray(w * np.where(small, 0.5, 0.5 * angle / np.where(small, 1.0, sine))[:, None])
