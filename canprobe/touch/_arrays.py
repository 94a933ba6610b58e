"""Array types and input checks that the touch modules share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from canprobe.errors import UsageError

Array = NDArray[np.float64]
_UPPER = np.triu(np.ones((10, 10), dtype=bool))


def upper_root(A: Array) -> Array:
    """The upper triangular R of a QR decomposition, Rᵀ R = Aᵀ A."""
    h, _ = np.linalg.qr(A, mode="raw")  # half the time of mode="r", which spends it on copies
    R = h.T[: min(A.shape)]
    return np.asarray(np.where(_UPPER, R, 0.0) if R.shape == _UPPER.shape else np.triu(R), dtype=np.float64)


def solved(A: Array, B: Array) -> Array:
    """A⁻¹ B."""
    return np.asarray(np.linalg.solve(A, B), dtype=np.float64)


def inverted(A: Array) -> Array:
    """A⁻¹."""
    return np.asarray(np.linalg.inv(A), dtype=np.float64)


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
