"""docs/scene-keys.md: the reference of all scene keys, from the dataclasses that describe them.

`docs/generate.py` writes the page.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from canprobe.cell.scene.checks import Only, conditions_of, expected
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.rules import SECTIONS_OF_TASK
from canprobe.cell.scene.toml_files import toml_value
from canprobe.cell.scene.units import unit_of

NEEDS = {"must": "required", "default": "default", "may": "optional", "mounted": "as in the cell", "never": "–"}
INTRODUCTION = """\
# Scene keys

A scene is a TOML file. `canprobe scenes` lists the packaged ones and prints the folder of their files: copy one and
change it. `canprobe plan FILE` checks a scene and reports every mistake at once, with the key and, where a name is
misspelt, the name that was probably meant.

`cell = "NAME"` above the first section names the cell, arm and array, that the scene runs on: a packaged one
(`canprobe cells`) or the path of a file; `puma260` without this line. `[arm]` and `[sensor]` say that the scene uses
the arm and the array of the cell, and may be empty. `written_by` above the first section of a file that canprobe wrote
says by which version; a file of your own needs none.

A key that a scene leaves out has the value of its cell ([Your own arm](own-arm.md)), then that of the array file that
the cell names ([Your own array](own-array.md)), or else its default. The suffix of a key is its unit. Numbers may be
written with or without a decimal point. `"auto"` leaves the choice to the plan, which prints what it chose and why.

This page is generated from the definition of a scene: `python docs/generate.py`.

## Sections and tasks

`[scene]` and `[task]` are needed in every scene; `[bus]`, `[cycle]`, `[outputs]`, `[limits]`, `[bring_up]`,
`[keep_out]` and `[bridge]` may stand in every scene. `[cell]`, `[arm]`, `[joints.NAME]`, `[postures]`, `[keep_out]`,
`[sensor]`, `[probe]` and `[emulate]` usually come from the cell file, and `[wire]` from the array file. The other
sections depend on `task.kind`. *required*: the scene must have the section. *default*: a scene without the section
has all its defaults. *optional*: a scene without the section does without it. *–*: the section is an error.
"""


POSTURES = (
    "Postures of the arm by name: a list of the positions of its joints, in degrees, or millimetres where they slide."
    " `canprobe move` goes there, `canprobe posture save` writes one; `start` is what the joints have as `start_deg` or"
    " `start_mm`."
)
"""Meaning of `[postures]`, whose keys are names."""


def scene_keys() -> str:
    """The page of all scene keys."""
    sections = [(name, section_class(hint)) for name, hint in typing.get_type_hints(Scene).items()]
    return "\n".join([INTRODUCTION, *_needs(), "", *(line for name, cls in sections for line in _section(name, cls))])


def meanings(cls: type[Any]) -> dict[str, str]:
    """The text below each field of a section, by key."""
    body = typing.cast(ast.ClassDef, ast.parse(inspect.getsource(cls)).body[0]).body
    return {
        field.target.id: inspect.cleandoc(text.value.value).replace("\n", " ")
        for field, text in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant) and isinstance(text.value.value, str)
    }


def section_class(hint: Any) -> type[Any]:
    """The dataclass of a section, from its annotation in a scene."""
    parts = typing.get_args(hint)
    cls: type[Any] = parts[1] if typing.get_origin(hint) is Mapping else next(iter(parts), hint)
    return cls


def _needs() -> Iterator[str]:
    tasks = list(SECTIONS_OF_TASK)
    yield f"| section | {' | '.join(f'`{task}`' for task in tasks)} |"
    yield "| --- |" + " --- |" * len(tasks)
    for section in SECTIONS_OF_TASK[tasks[0]]:
        needs = (NEEDS[SECTIONS_OF_TASK[task][section][0]] for task in tasks)
        title = "joints.NAME" if section == "joints" else section
        yield f"| [`[{title}]`](#{title.lower().replace('.', '')}) | {' | '.join(needs)} |"


def _section(name: str, cls: type[Any]) -> Iterator[str]:
    if not dataclasses.is_dataclass(cls):
        yield f"## `[{name}]`\n\n{POSTURES}\n"
        return
    head, _, rest = (inspect.getdoc(cls) or "").partition("\n\n")
    about = head.partition(": ")[2].replace("\n", " ")
    yield f"## `[{'joints.NAME' if name == 'joints' else name}]`\n"
    yield about[0].upper() + about[1:]
    if rest:
        yield f"\n{rest}"
    yield "\n| key | value | unit | default | meaning |"
    yield "| --- | --- | --- | --- | --- |"
    annotations, texts = typing.get_type_hints(cls, include_extras=True), meanings(cls)
    for field in dataclasses.fields(cls):
        annotation = annotations[field.name]
        cells = (
            f"`{field.name}`",
            expected(annotation),
            unit_of(field.name).text,
            _default(field),
            " ".join([texts[field.name], *map(_condition, conditions_of(annotation, Only))]),
        )
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
    yield ""


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is dataclasses.MISSING:
        return "required"
    return "–" if field.default is None else f"`{toml_value(field.default)}`"


def _condition(only: Only) -> str:
    values = " or ".join(f"`{toml_value(value)}`" for value in only.values)
    return f"*{'Required' if only.required else 'Only'} with `{only.key}` = {values}.*"
