"""Checks of what a user gives: arrays and numbers as floats, or a `UsageError` that names the field."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from canprobe.errors import UsageError
from canprobe.mechanics.types import Floats

_T = TypeVar("_T")


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
