"""What a value of a scene may be: small checks that stand in the annotations of `canprobe.scene`, and `convert`.

`convert` turns what `tomllib` read into the annotated type, or says what was expected. Nothing is coerced silently
except an integer where a number is wanted (TOML's `25` for `25.0`); a boolean is never a number.
"""

from __future__ import annotations

import math
import re
import types
import typing
from dataclasses import dataclass
from typing import Any, Literal


class MismatchError(ValueError):
    """A value that is not what its annotation says; the text is what was expected."""


@dataclass(frozen=True, slots=True)
class Range:
    """Numbers from `low` to `high`, both included unless `open_low` leaves the lower end out."""

    low: float
    high: float
    open_low: bool = False

    def __str__(self) -> str:
        low, high = (str(end) if isinstance(end, int) else f"{end:g}" for end in (self.low, self.high))
        return f"above {low} up to {high}" if self.open_low else f"from {low} to {high}"

    def accepts(self, value: float) -> bool:
        return (self.low < value if self.open_low else self.low <= value) and value <= self.high


@dataclass(frozen=True, slots=True)
class OneOf:
    """One of a few numbers."""

    values: tuple[int, ...]

    def __str__(self) -> str:
        return f"of {', '.join(map(str, self.values))}"

    def accepts(self, value: int) -> bool:
        return value in self.values


@dataclass(frozen=True, slots=True)
class Pattern:
    """Text that matches a regular expression as a whole."""

    regex: str
    text: str

    def __str__(self) -> str:
        return self.text

    def accepts(self, value: str) -> bool:
        return re.fullmatch(self.regex, value) is not None


@dataclass(frozen=True, slots=True)
class Distinct:
    """A list without repetitions."""

    def __str__(self) -> str:
        return "all different"

    def accepts(self, value: tuple[object, ...]) -> bool:
        return len(set(value)) == len(value)


@dataclass(frozen=True, slots=True)
class Direction:
    """A vector that has a direction."""

    def __str__(self) -> str:
        return "not all zero"

    def accepts(self, value: tuple[float, ...]) -> bool:
        return math.hypot(*value) > 1e-9


@dataclass(frozen=True, slots=True)
class Symmetric:
    """A symmetric matrix."""

    def __str__(self) -> str:
        return "symmetric"

    def accepts(self, value: tuple[tuple[float, ...], ...]) -> bool:
        return all(value[i][j] == value[j][i] for i in range(len(value)) for j in range(i))


@dataclass(frozen=True, slots=True)
class Only:
    """The key belongs only to sections whose `key` has one of `values`; elsewhere giving it is an error.

    With `required` it must be given there.
    """

    key: str
    values: tuple[str, ...]
    required: bool = False


@dataclass(frozen=True, slots=True)
class ScenePath:
    """A packaged file's name, or a path that is looked up beside the scene file first."""


_UNIONS = (types.UnionType, typing.Union)
CONDITIONS = (Only, ScenePath)
"""Annotations that say something about the key and nothing about its value."""


def convert(value: object, annotation: Any) -> Any:
    """Return `value` as the annotated type.

    Args:
        value: as read by `tomllib`.
        annotation: a type, `Annotated` with checks, `Literal`, `tuple[...]` or `X | None`.

    Raises:
        MismatchError: with what was expected.
    """
    origin = typing.get_origin(annotation)
    if origin is typing.Annotated:
        return _checked(value, annotation)
    if origin in _UNIONS:
        return _converted_choice(value, annotation)
    if origin is Literal:
        if value not in typing.get_args(annotation):
            raise MismatchError(expected(annotation))
        return value
    if origin is tuple:
        return _converted_list(value, annotation)
    return _converted_scalar(value, annotation)


def _members(annotation: Any) -> list[Any]:
    """The members of a union besides None."""
    return [part for part in typing.get_args(annotation) if part is not type(None)]


def _converted_choice(value: object, annotation: Any) -> Any:
    for part in _members(annotation):
        try:
            return convert(value, part)
        except MismatchError:
            continue
    raise MismatchError(expected(annotation))


def _checked(value: object, annotation: Any) -> Any:
    base, *checks = typing.get_args(annotation)
    try:
        converted = convert(value, base)
    except MismatchError:
        raise MismatchError(expected(annotation)) from None
    if not all(check.accepts(converted) for check in checks if not isinstance(check, CONDITIONS)):
        raise MismatchError(expected(annotation))
    return converted


def _converted_list(value: object, annotation: Any) -> tuple[Any, ...]:
    parts = typing.get_args(annotation)
    if not isinstance(value, list | tuple):
        raise MismatchError(expected(annotation))
    types_of_items = [parts[0]] * len(value) if parts[-1] is Ellipsis else list(parts)
    if len(types_of_items) != len(value):
        raise MismatchError(expected(annotation))
    try:
        return tuple(convert(item, kind) for item, kind in zip(value, types_of_items, strict=True))
    except MismatchError:
        raise MismatchError(expected(annotation)) from None


def _converted_scalar(value: object, kind: Any) -> Any:
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        try:
            value = float(value)
        except OverflowError:
            raise MismatchError("a finite number") from None
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise MismatchError(expected(kind))
    if isinstance(value, float) and not math.isfinite(value):
        raise MismatchError("a finite number")
    return value


def _expected_member(annotation: Any) -> str:
    words = typing.get_args(annotation) if typing.get_origin(annotation) is Literal else ()
    return f'"{words[0]}"' if len(words) == 1 else expected(annotation)


_NAMES = {float: ("a number", "numbers"), int: ("an integer", "integers"), str: ("text", "texts")}


def expected(annotation: Any) -> str:
    """What an annotation asks for, in words."""
    origin = typing.get_origin(annotation)
    if origin is typing.Annotated:
        base, *checks = typing.get_args(annotation)
        return " ".join([expected(base), *(str(check) for check in checks if not isinstance(check, CONDITIONS))])
    if origin in _UNIONS:
        return " or ".join(map(_expected_member, _members(annotation)))
    if origin is Literal:
        return "one of " + ", ".join(typing.get_args(annotation))
    if origin is tuple:
        return _expected_list(typing.get_args(annotation))
    return _NAMES[annotation][0] if annotation in _NAMES else "true or false"


def _expected_list(parts: tuple[Any, ...]) -> str:
    item = parts[0]
    many = _NAMES[item][1] if item in _NAMES else f"items, each {expected(item)}"
    return f"a list of {many}" if parts[-1] is Ellipsis else f"a list of {len(parts)} {many}"


def choices_of(annotation: Any) -> tuple[str, ...]:
    """The words that an annotation allows, for "did you mean"; empty when it is not a choice."""
    origin = typing.get_origin(annotation)
    if origin is Literal:
        return typing.get_args(annotation)
    if origin in _UNIONS:
        return tuple(word for part in _members(annotation) for word in choices_of(part))
    if origin in (typing.Annotated, tuple):
        return choices_of(typing.get_args(annotation)[0])
    return ()


def conditions_of(annotation: Any, kind: type[Any]) -> list[Any]:
    """The conditions of one kind that stand in an annotation."""
    return [part for part in getattr(annotation, "__metadata__", ()) if isinstance(part, kind)]
