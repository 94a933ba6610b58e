"""Write a scene as TOML: every value that was resolved, nothing that its kind does not use."""

from __future__ import annotations

import dataclasses
import typing
from typing import Any

from canprobe.scene import Scene
from canprobe.scene_checks import Only, conditions_of


def dump_scene(scene: Scene) -> str:
    """The scene as a TOML document that loads back equal.

    Args:
        scene: a scene as `load_scene` gave it.
    """
    sections = [(field.name, getattr(scene, field.name)) for field in dataclasses.fields(scene)]
    return "\n".join(_section(name, section) for name, section in sections if section is not None)


def toml_value(value: object) -> str:
    """One value as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{"".join(map(_escaped, value))}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {toml_value(item)}' for key, item in value.items())}}}"
    return repr(value) if isinstance(value, int | float) else str(value)


def _section(name: str, section: Any) -> str:
    annotations = typing.get_type_hints(type(section), include_extras=True)
    lines = [
        f"{field.name} = {toml_value(value)}\n"
        for field in dataclasses.fields(section)
        if (value := getattr(section, field.name)) is not None and _applies(section, annotations[field.name])
    ]
    return f"[{name}]\n{''.join(lines)}"


def _applies(section: Any, annotation: Any) -> bool:
    return all(getattr(section, only.key) in only.values for only in conditions_of(annotation, Only))


_ESCAPES = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\t": "\\t", "\r": "\\r", "\b": "\\b", "\f": "\\f"}


def _escaped(character: str) -> str:
    if character in _ESCAPES:
        return _ESCAPES[character]
    return f"\\u{ord(character):04X}" if ord(character) < 0x20 or ord(character) == 0x7F else character
