"""Postures in a cell file: taught by a person, written without touching the rest of the file."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.rules import START
from canprobe.cell.scene.toml_files import read_toml, toml_key, toml_value
from canprobe.errors import ResultsError, UsageError
from canprobe.fieldbus.bus.files import whole_file, writing
from canprobe.mechanics.robot.model import Joint
from canprobe.mechanics.types import Floats

_HEADER = re.compile(r"\s*\[postures\]\s*(#.*)?")
_SECTION = re.compile(r"\s*\[")


def postures_file(path: Path, name: str) -> dict[str, Any]:
    """The document of a cell file that a posture of this name can be written into.

    Raises:
        UsageError: the file has no joints, the name is that of the start, or the file is packaged.
        SceneError: the file cannot be read.
    """
    if not path.is_file():
        raise UsageError(
            f"posture save: expected the path of a cell file, got {path}; `canprobe init` makes one of a packaged cell"
        )
    if name == START:
        raise UsageError(f"posture save: {name} is what the joints have as start_deg or start_mm; choose another name")
    wanted = read_toml(path, str(path))
    if "joints" not in wanted:
        raise UsageError(f"{path}: has no [joints.NAME]; save into the cell file that it names")
    return wanted


def save_posture(path: Path, name: str, joints: Sequence[Joint], q: Floats) -> None:
    """Write a posture into a cell file, in the place of one of that name; comments and order stay.

    Args:
        path: the file.
        name: name of the posture.
        joints: the joints of the arm.
        q: (n,) their positions, rad or m.

    Raises:
        UsageError, SceneError: as for `postures_file`.
        ResultsError: it cannot be written, or only by a change of more than this line.
    """
    wanted = postures_file(path, name)
    posture = [round(its.shown(value), 4) for its, value in zip(joints, q.tolist(), strict=True)]
    wanted.setdefault("postures", {})[name] = posture
    text = path.read_text(encoding="utf-8-sig")
    changed = _with_line(text, name, f"{toml_key(name)} = {toml_value(posture)}")
    if tomllib.loads(changed) != wanted:
        raise ResultsError(
            f"{path}: [postures] is written in a way that this cannot change; put it there yourself:"
            f" {toml_key(name)} = {toml_value(posture)}"
        )
    load_scene(path, {f"postures.{toml_key(name)}": posture})
    with writing(path), whole_file(path) as part:
        part.write_text(changed, encoding="utf-8")


def _with_line(text: str, name: str, line: str) -> str:
    """A TOML text with a line of the section [postures]."""
    lines = text.splitlines()
    begin = next((i for i, one in enumerate(lines) if _HEADER.fullmatch(one)), None)
    if begin is None:
        return "\n".join([*lines, "", "[postures]", line, ""])
    end = next((i for i in range(begin + 1, len(lines)) if _SECTION.match(lines[i])), len(lines))
    key = re.compile(rf"\s*(?:{re.escape(toml_key(name))}|\"{re.escape(name)}\")\s*=")
    own = [i for i in range(begin + 1, end) if key.match(lines[i])]
    place = own[0] if own else begin + 1
    return "\n".join([*lines[:place], line, *lines[place + len(own) :], ""])
