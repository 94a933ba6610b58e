"""Runs whose figures nobody looks at: drawing them takes longer than a short run."""

from __future__ import annotations

from typing import Any

import pytest

import canprobe
from canprobe.results import RunResult
from canprobe.scene import Scene


def undrawn_run(scene: Scene, **options: Any) -> RunResult:
    """`canprobe.run` that leaves all its files but the figures."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("canprobe.api._draw", lambda result, folder: None)
        return canprobe.run(scene, **options)
