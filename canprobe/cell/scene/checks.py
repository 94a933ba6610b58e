"""Checks of the values of a file, which stand in the annotations of `canprobe.cell.scene.model`, and `convert`.

`convert` turns what `tomllib` read into the annotated type, or says what was expected. Nothing is coerced silently
except an integer where a number is wanted (TOML's `25` for `25.0`); a boolean is never a number.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal


class MismatchError(ValueError):
    """A value that does not match its annotation; the text is what was expected."""


@dataclass(frozen=True, slots=True)
class Check:
    """A condition on a value.

    Attributes:
        text: what is asked for, in words.
        accepts: whether a value has it.
        schema: the same in the words of JSON Schema, draft 7; empty where these do not express it.
    """

    text: str
    accepts: Callable[[Any], bool]
    schema: Mapping[str, Any] = field(default_factory=dict, hash=False)


def Range(low: float, high: float, *, open_low: bool = False) -> Check:
    """Numbers from `low` to `high`, both included unless `open_low` leaves the lower end out."""
    first, last = (str(end) if isinstance(end, int) else f"{end:g}" for end in (low, high))
    if open_low:
        return Check(
            f"above {first} up to {last}",
            lambda value: value - low >= _MIN_ABOVE_LIMIT and value <= high,
            {"exclusiveMinimum": low, "maximum": high},
        )
    return Check(f"from {first} to {last}", lambda value: low <= value <= high, {"minimum": low, "maximum": high})


def OneOf(values: tuple[int, ...]) -> Check:
    """One of a few numbers."""
    return Check(f"of {', '.join(map(str, values))}", values.__contains__, {"enum": list(values)})


def Pattern(regex: str, text: str) -> Check:
    """Text that matches a regular expression as a whole."""
    return Check(text, lambda value: re.fullmatch(regex, value) is not None, {"pattern": f"^(?:{regex})$"})


DISTINCT = Check("all different", lambda value: len(set(value)) == len(value), {"uniqueItems": True})
DIRECTION = Check("not all zero", lambda value: math.hypot(*value) > 1e-9)
SYMMETRIC = Check("symmetric", lambda value: tuple(zip(*value, strict=True)) == value)


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
    """A packaged file's name, or a path that is looked up beside the file first."""


MAX_NUMBER = 1e20
"""Largest size of a number in any unit of a scene: products of such numbers are finite."""
_MIN_ABOVE_LIMIT = 1e-30
"""Least distance of a number above an excluded limit: quotients by it are finite."""

_UNIONS = (types.UnionType, typing.Union)
_NAMES = {float: ("a number", "numbers"), int: ("an integer", "integers"), str: ("text", "texts")}


def convert(value: object, annotation: Any) -> Any:
    """Return `value` as the annotated type.

    Args:
        value: the value as `tomllib` read it.
        annotation: a type, `Annotated` with checks, `Literal`, `tuple[...]` or `X | None`.

    Raises:
        MismatchError: the value has another type or range; the text is what was expected.
    """
    try:
        return _converted(value, annotation)
    except (ValueError, OverflowError):  # the latter for an integer that no float holds
        unsaid = _beyond(value) and not conditions_of(annotation, Check)  # no range says it
        beyond = f", at most {MAX_NUMBER:g} in size" if unsaid else ""
        raise MismatchError(f"{expected(annotation)}{beyond}") from None


def _converted(value: object, annotation: Any) -> Any:
    """Convert as `convert` does; a value that does not match raises a ValueError without a text."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        converted = _converted(value, parts[0])
        matches = all(check.accepts(converted) for check in conditions_of(annotation, Check))
    elif origin in _UNIONS:
        for part in _members(annotation):
            with contextlib.suppress(ValueError):
                return _converted(value, part)
        raise ValueError
    elif origin is Literal:
        converted, matches = value, value in parts
    elif origin is tuple:
        items = value if isinstance(value, list | tuple) else ()
        kinds = [parts[0]] * len(items) if parts[-1] is Ellipsis else list(parts)
        matches = isinstance(value, list | tuple) and len(items) == len(kinds)
        converted = tuple(_converted(item, kind) for item, kind in zip(items, kinds, strict=False))
    elif origin is Mapping:
        matches = isinstance(value, dict)
        table = value if isinstance(value, dict) else {}
        converted = {_converted(key, parts[0]): _converted(item, parts[1]) for key, item in table.items()}
    else:
        number = annotation is float and type(value) is int
        converted = float(value) if number else value  # type: ignore[arg-type]  # an int here
        matches = type(converted) is annotation and not _beyond(converted)
    if not matches:
        raise ValueError
    return converted


def _beyond(value: object) -> bool:
    """Whether a number, or one in a list, is not finite or larger than `MAX_NUMBER`."""
    if isinstance(value, list | tuple):
        return any(map(_beyond, value))
    return isinstance(value, int | float) and not abs(value) <= MAX_NUMBER


def _members(annotation: Any) -> list[Any]:
    """The members of a union besides None."""
    return [part for part in typing.get_args(annotation) if part is not type(None)]


def expected(annotation: Any) -> str:
    """The expected value of an annotation, in words."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return " ".join([expected(parts[0]), *(check.text for check in conditions_of(annotation, Check))])
    if origin in _UNIONS:
        words = (choices_of(part) for part in _members(annotation))
        members = zip(_members(annotation), words, strict=True)
        return " or ".join(f'"{word[0]}"' if len(word) == 1 else expected(part) for part, word in members)
    if origin is Literal:
        return "one of " + ", ".join(parts)
    if origin is tuple:
        many = _NAMES[parts[0]][1] if parts[0] in _NAMES else f"items, each {expected(parts[0])}"
        return f"a list of {many}" if parts[-1] is Ellipsis else f"a list of {len(parts)} {many}"
    if origin is Mapping:
        keys = " or ".join(choices_of(parts[0]))
        return f"a table of {keys}: {expected(parts[1])}" if keys else f"a table of {_NAMES[parts[1]][1]}"
    return _NAMES[annotation][0] if annotation in _NAMES else "true or false"


def choices_of(annotation: Any) -> tuple[str, ...]:
    """The words that an annotation allows, for "did you mean"; empty when it is not a choice."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Literal:
        return parts
    if origin in _UNIONS:
        return tuple(word for part in parts for word in choices_of(part))
    return choices_of(parts[0]) if origin in (typing.Annotated, tuple) else ()


def conditions_of(annotation: Any, kind: type[Any]) -> list[Any]:
    """The conditions of one kind in an annotation: `Check`, `Only` or `ScenePath`."""
    return [part for part in getattr(annotation, "__metadata__", ()) if isinstance(part, kind)]


_ANNOTATIONS: dict[type, Mapping[str, Any]] = {}


def annotations_of(cls: type[Any]) -> Mapping[str, Any]:
    """The types of a section's keys, evaluated once: that takes longer than to read a file."""
    if cls not in _ANNOTATIONS:
        _ANNOTATIONS[cls] = typing.get_type_hints(cls, include_extras=True)
    return _ANNOTATIONS[cls]


def values_of(section: Any) -> Any:
    """The keys of a section that have a value and belong to the others; what is no section as it is."""
    if not dataclasses.is_dataclass(section):
        return section
    values = {key: getattr(section, key) for key in annotations_of(type(section))}
    return {key: values[key] for key in keys_that_belong(type(section), values) if values[key] is not None}


def keys_that_belong(cls: type[Any], values: Mapping[str, Any]) -> list[str]:
    """The keys of a section whose conditions hold with these values."""
    return [
        key
        for key, annotation in annotations_of(cls).items()
        if all(values[only.key] in only.values for only in conditions_of(annotation, Only))
    ]
