"""Scenes with some fields replaced, and why a scene has no plan."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

import canprobe
from canprobe.cell.scene.model import Scene
from canprobe.errors import PlanError
from canprobe.fieldbus.eds.packaged import eds_path


def change(scene: Scene, /, **sections: dict[str, Any]) -> Scene:
    """A scene with some fields of some sections replaced."""
    changed = {name: dataclasses.replace(getattr(scene, name), **fields) for name, fields in sections.items()}
    return dataclasses.replace(scene, **changed)


def with_joints(scene: Scene, /, **keys: Sequence[Any]) -> Scene:
    """A scene with some keys of its joints replaced, a value for each joint from the base."""
    joints = {
        name: dataclasses.replace(joint, **{key: values[i] for key, values in keys.items()})
        for i, (name, joint) in enumerate(scene.joints.items())
    }
    return dataclasses.replace(scene, joints=joints)


def with_eds(scene: Scene, folder: Path, *edits: tuple[str, str]) -> Scene:
    """A scene whose drives have the packaged EDS with patterns replaced."""
    text = eds_path("puma260_joint").read_text(encoding="ascii")
    for pattern, new in edits:
        text, found = re.subn(pattern, new, text, flags=re.DOTALL)
        assert found, pattern
    path = folder / "other.eds"
    path.write_text(text, encoding="ascii")
    return change(scene, arm={"eds": str(path)})


def without_torque(scene: Scene, folder: Path, *, fixed: bool) -> Scene:
    """A scene with drives whose TPDO cannot carry 6077h: its mapping is fixed, or the object cannot be mapped."""
    count = r"(\[1A00sub0\][^\[]*"
    edits = [(count + "AccessType=)rw", r"\g<1>ro"), (count + "DefaultValue=)3", r"\g<1>2")]
    return with_eds(scene, folder, *(edits if fixed else [(r"(\[6077\][^\[]*PDOMapping=)1", r"\g<1>0")]))


def refused(scene: Scene) -> PlanError:
    """Why a scene that must have no plan has none."""
    with pytest.raises(PlanError) as caught:
        canprobe.plan(scene)
    return caught.value


def reasons(scene: Scene) -> tuple[str, ...]:
    """The problems of a scene that must have some."""
    return refused(scene).problems


def ways_out(scene: Scene) -> tuple[str, ...]:
    """What would make a scene fit that must not."""
    return refused(scene).ways_out
