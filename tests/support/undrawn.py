"""Runs whose figures nobody looks at: drawing them takes longer than a short run."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import canprobe
from canprobe.cell.results.result import RunResult
from canprobe.cell.scene.model import Scene


def undrawn(scene: Scene) -> Scene:
    """The scene, whose runs leave all their files but the figures."""
    return replace(scene, outputs=replace(scene.outputs, figures=False))


def undrawn_run(scene: Scene, **options: Any) -> RunResult:
    """`canprobe.run` of such a scene."""
    return canprobe.run(undrawn(scene), **options)
