"""Scenes with some fields replaced, and why a scene has no plan."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

import canprobe
from canprobe.errors import PlanError
from canprobe.scene import Scene


def change(scene: Scene, **sections: dict[str, Any]) -> Scene:
    """A scene with some fields of some sections replaced."""
    changed = {name: dataclasses.replace(getattr(scene, name), **fields) for name, fields in sections.items()}
    return dataclasses.replace(scene, **changed)


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
