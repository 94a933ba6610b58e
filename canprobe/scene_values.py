"""What a caller puts in the place of a scene's own values: checked as those of a scene file are."""

from __future__ import annotations

import tomllib
import typing
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from canprobe.errors import UsageError
from canprobe.scene import Scene
from canprobe.scene_checks import MismatchError, convert

_Section = TypeVar("_Section")


def need_scene(scene: object) -> None:
    """Complain about anything else in the place of a scene, such as its name.

    Raises:
        UsageError: with what was got.
    """
    if not isinstance(scene, Scene):
        raise UsageError(f"scene: expected what canprobe.load_scene returns, got {scene!r}")


def with_values(section: _Section, **values: object) -> _Section:
    """A section of a scene with some of its values replaced.

    Args:
        section: one of the dataclasses of `canprobe.scene`.
        values: by key, numbers of numpy too; None keeps what the section has.

    Raises:
        UsageError: naming the key, what was expected and what was got.
    """
    given = {key: value for key, value in values.items() if value is not None}
    if not given:
        return section
    annotations = typing.get_type_hints(type(section), include_extras=True)
    changes = {key: _checked(key, value, annotations[key]) for key, value in given.items()}
    return replace(section, **changes)  # type: ignore[type-var]  # a dataclass, as all sections are


def with_choices(scene: Scene, choices: Mapping[str, str]) -> Scene:
    """A scene with what was chosen in the place of its "auto".

    Args:
        scene: with open keys.
        choices: value by key path, as a scene file writes it: `{"sensor.mode": '"window"'}`.
    """
    for path, text in choices.items():
        section, _, key = path.partition(".")
        value = tomllib.loads(f"value = {text}")["value"]
        scene = replace(scene, **{section: replace(getattr(scene, section), **{key: value})})
    return scene


def _checked(key: str, value: object, annotation: Any) -> Any:
    try:
        return convert(value.item() if isinstance(value, np.generic) else value, annotation)
    except MismatchError as mismatch:
        raise UsageError(f"{key}: expected {mismatch}, got {value!r}") from None
