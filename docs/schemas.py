"""JSON Schemas (draft 7) of scene, cell and array files, from the dataclasses that describe them.

A schema knows what one key and one section say: names, types, ranges, words, which keys go with which kind, and which
sections a task has. What compares numbers of two keys, asks for a file, or asks whether the cell can do it, is left to
`canprobe plan`. `docs/generate.py` writes the schemas; `canprobe schema` prints them.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator, Mapping
from typing import Any, Literal

from scene_keys import POSTURES, meanings, section_class

from canprobe.cell.scene.checks import MAX_NUMBER, Check, Only, conditions_of
from canprobe.cell.scene.model import ArrayFile, CellFile, Scene
from canprobe.cell.scene.rules import SECTIONS_OF_TASK
from canprobe.cell.scene.toml_files import WRITTEN_BY_KEY
from canprobe.cell.scene.units import unit_of

FILES: Mapping[str, type[Any]] = {"scene": Scene, "cell": CellFile, "array": ArrayFile}
WHOLE_SECTIONS = {
    "scene": {"scene", "task", "object", "shape", "bridge"},
    "cell": {"joints"},
    "array": {"sensor", "wire"},
}
"""Sections that no other file fills: a key that is left out there has its default."""
REQUIRED_SECTIONS = {"scene": ["scene", "task"], "cell": [], "array": ["sensor"]}
CELL_OF_A_SCENE = "Cell that the scene runs on: a packaged name (`canprobe cells`), or the path of a file."
WRITER = "Version of canprobe that wrote the file."
JsonSchema = dict[str, Any]
TYPES: Mapping[Any, JsonSchema] = {
    float: {"type": ["number", "integer"], "minimum": -MAX_NUMBER, "maximum": MAX_NUMBER},
    int: {"type": "integer", "minimum": -MAX_NUMBER, "maximum": MAX_NUMBER},
    str: {"type": "string"},
    bool: {"type": "boolean"},
}
"""Schemas of plain values. tombi explains a whole number on hover only where both types of a number are named."""


def schema_of(file: str) -> JsonSchema:
    """The schema of a "scene", "cell" or "array" file."""
    sections = typing.get_type_hints(FILES[file])
    properties: JsonSchema = {WRITTEN_BY_KEY: {"type": "string", "description": WRITER}}
    for name, hint in sections.items():
        cls = section_class(hint)
        section = (
            section_schema(cls, whole=name in WHOLE_SECTIONS[file])
            if dataclasses.is_dataclass(cls)
            else value_schema(cls)
        )
        if typing.get_origin(hint) is Mapping:
            section = {"type": "object", "additionalProperties": section}
            section |= {} if dataclasses.is_dataclass(cls) else {"description": POSTURES}
        properties[name] = section
    if file == "scene":
        properties["cell"] = {
            "description": CELL_OF_A_SCENE,
            "anyOf": [{"type": "string"}, {**properties["cell"], "required": ["name"]}],
        }
    rules = list(_rules_of_tasks()) if file == "scene" else []
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": f"{'an' if file == 'array' else 'a'} {file} file of canprobe",
        "type": "object",
        "properties": properties,
        "required": REQUIRED_SECTIONS[file],
        "additionalProperties": False,
        **({"allOf": rules} if rules else {}),
    }


def section_schema(cls: type[Any], *, whole: bool) -> JsonSchema:
    """The schema of a section.

    Args:
        cls: dataclass of the section.
        whole: no other file fills the section: keys without a default are required, and a key that is left out counts
            as its default in the conditions of others.
    """
    annotations, texts = typing.get_type_hints(cls, include_extras=True), meanings(cls)
    properties, required, rules = {}, [], []
    for field in dataclasses.fields(cls):
        annotation = annotations[field.name]
        unit = unit_of(field.name).text
        about: JsonSchema = {"description": texts[field.name] + (f" Unit: {unit}." if unit else "")}
        if field.default is dataclasses.MISSING:
            required += [field.name] if whole else []
        elif field.default is not None:
            about["default"] = field.default
        properties[field.name] = about | value_schema(annotation)
        for only in conditions_of(annotation, Only):
            rules += _rules_of_condition(field.name, only, annotations, _default_of(cls, only.key), whole=whole)
    return {
        "type": "object",
        "properties": properties,
        **({"required": required} if required else {}),
        "additionalProperties": False,
        **({"allOf": rules} if rules else {}),
    }


def value_schema(annotation: Any) -> JsonSchema:
    """The schema of a value, from its annotation in a section."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    schema: JsonSchema
    if origin is typing.Annotated:
        schema = _checked(value_schema(parts[0]), conditions_of(annotation, Check))
    elif origin in (types.UnionType, typing.Union):
        members = [value_schema(part) for part in parts if part is not type(None)]
        schema = members[0] if len(members) == 1 else {"anyOf": members}
    elif origin is Literal:
        schema = {"enum": list(parts)}
    elif origin is tuple:
        length = {} if parts[-1] is Ellipsis else {"minItems": len(parts), "maxItems": len(parts)}
        schema = {"type": "array", "items": value_schema(parts[0]), **length}
    elif origin is Mapping and typing.get_origin(parts[0]) is Literal:
        keys = dict.fromkeys(typing.get_args(parts[0]), value_schema(parts[1]))
        schema = {"type": "object", "properties": keys, "additionalProperties": False}
    elif origin is Mapping:
        schema = {"type": "object", "additionalProperties": value_schema(parts[1])}
    else:
        schema = TYPES[annotation]
    return schema


def _checked(schema: JsonSchema, checks: list[Check]) -> JsonSchema:
    for check in checks:
        schema = schema | check.schema
        if "exclusiveMinimum" in check.schema:
            schema.pop("minimum", None)
    return schema


def _default_of(cls: type[Any], key: str) -> Any:
    return next(field.default for field in dataclasses.fields(cls) if field.name == key)


def _rules_of_condition(
    key: str, only: Only, annotations: Mapping[str, Any], default: Any, *, whole: bool
) -> Iterator[JsonSchema]:
    """`key` does not stand where `only.key` has another value; where it has one of these it may be required."""
    others = [word for word in _words_of(annotations[only.key]) if word not in only.values]
    yield {"if": _has(only.key, others, default, whole=whole), "then": {"properties": {key: False}}}
    if only.required and whole:
        yield {"if": _has(only.key, list(only.values), default, whole=whole), "then": {"required": [key]}}


def _words_of(annotation: Any) -> list[str]:
    schema = value_schema(annotation)
    return [word for part in schema.get("anyOf", [schema]) for word in part.get("enum", [])]


def _has(key: str, values: list[str], default: Any, *, whole: bool) -> JsonSchema:
    """A key has one of the values, given or by default."""
    given = {"properties": {key: {"enum": values}}}
    return given if whole and default in values else {**given, "required": [key]}


def _rules_of_tasks() -> Iterator[JsonSchema]:
    """Which sections a scene of a task has not. Those that it must have may come from its cell."""
    for task, needs in SECTIONS_OF_TASK.items():
        never = {section: False for section, (need, _) in needs.items() if need == "never"}
        if never:
            kind = {"properties": {"kind": {"const": task}}, "required": ["kind"]}
            yield {"if": {"properties": {"task": kind}}, "then": {"properties": never}}
