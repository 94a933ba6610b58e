"""Our master on drives that share no code with our emulator: written by hand on a raw socket, in modes 8 and 7."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from patience import patience_s

import canprobe
from canprobe.fieldbus.eds.packaged import eds_path
from canprobe.mechanics.robot.model import joints_to_units

pytestmark = pytest.mark.vcan
ON_VCAN0 = ("--bus", "socketcan", "--channel", "vcan0")
CELLS = Path(canprobe.__file__).parent / "cells"
PROGRAM = Path(__file__).parents[1] / "support" / "foreign_drive.py"
OFF, PRE_OPERATIONAL = 0x40, 0x7F
SWINGING = 500
"""Counts that every joint of `free` moves at least."""


class Foreign:
    """A process that serves drives by hand."""

    def __init__(self, eds: str | Path, mode: int, positions: dict[int, int]) -> None:
        nodes = [f"{node_id}={position}" for node_id, position in positions.items()]
        words = [sys.executable, PROGRAM, "vcan0", eds, mode, *nodes]
        self._process = subprocess.Popen([str(word) for word in words], stdout=subprocess.PIPE, text=True)

    def wait(self) -> Foreign:
        """Until it serves."""
        assert self._process.stdout is not None and self._process.stdout.readline() == "serving\n"
        return self

    def end(self) -> dict[int, dict[str, Any]]:
        """End it; what each drive saw, by node id."""
        self._process.terminate()
        out, _ = self._process.communicate(timeout=patience_s(20))
        assert self._process.returncode == 0
        return {seen["node_id"]: seen for seen in map(json.loads, out.splitlines())}

    def kill(self) -> None:
        with self._process:  # at its end the pipe is closed, too
            self._process.kill()


@pytest.fixture
def foreign(vcan0: str) -> Iterator[Any]:
    """Start foreign drives; they are gone at the end."""
    started: list[Foreign] = []

    def start(*arguments: Any) -> Foreign:
        started.append(Foreign(*arguments))
        return started[-1].wait()

    yield start
    for one in started:
        one.kill()


def start_positions(scene: Path) -> dict[int, int]:
    """Where each drive of a scene stands at first, in its units."""
    arm = canprobe.plan(canprobe.load_scene(scene)).setup.arm
    assert arm is not None
    return dict(zip(arm.node_ids, map(round, joints_to_units(arm.model, arm.q_start).tolist()), strict=True))


def assert_swung(seen: dict[str, Any], enable_word: int) -> None:
    """Enabled step by step, moved, and left without power."""
    words = seen["words"]
    steps = [words.index(word) for word in (0x06, 0x07, enable_word)]
    assert steps == sorted(steps), words
    assert seen["highest"] - seen["lowest"] > SWINGING
    assert (seen["state"], seen["nmt"]) == (OFF, PRE_OPERATIONAL)


def test_an_arm_of_six_foreign_drives_in_mode_8(bench: Any, foreign: Any) -> None:
    scene = bench.scene("free", emulated=False)
    positions = start_positions(scene)
    drives = foreign(eds_path("puma260_joint"), 8, positions)
    command = bench.start("run", scene, *ON_VCAN0, "--duration", 1.5, "--out", "results", "--json")
    assert command.end(0) == []
    seen = drives.end()
    assert tuple(seen) == tuple(positions)
    for drive in seen.values():
        assert_swung(drive, 0x0F)
    summary = json.loads(command.out)
    assert summary["completed"] is True
    results = bench.results("results")
    assert all(can_id & 0x780 != 0x080 or can_id == 0x080 for _, _, can_id, _ in results.frames), "no emergencies"


SCENE = """
cell = "{cell}"
[scene]
name = "foreign"
[outputs]
figures = false
[arm]
missed_syncs = 20
[task]
kind = "free"
duration_s = 3
swing_period_s = 3
[cycle]
rate_hz = 100
[limits]
late_cycles_max_percent = 100
[joints.{joint}]
emulated = false
"""


@pytest.mark.slow(reason="one foreign drive; the default runs six")
@pytest.mark.parametrize(
    ("cell", "joint", "eds", "mode", "node_id", "position", "word"),
    [
        pytest.param(
            *("puma260", "joint_2", "puma260_joint", 8, 2, 12634, 0x0F),
            marks=pytest.mark.skipif(not (CELLS / "puma260.toml").is_file(), reason="needs cells with mixed drives"),
        ),
        pytest.param(
            *("prbt", "prbt_joint_2", "prbt_joint", 7, 4, 7000, 0x1F),
            marks=pytest.mark.skipif(not (CELLS / "prbt.toml").is_file(), reason="needs mode 7 in the master"),
        ),
    ],
)
def test_one_joint_is_foreign_and_the_emulator_serves_the_others(  # noqa: PLR0917
    bench: Any, foreign: Any, cell: str, joint: str, eds: str, mode: int, node_id: int, position: int, word: int
) -> None:
    scene = bench.folder / "foreign.toml"
    scene.write_text(SCENE.format(cell=cell, joint=joint))
    drives = foreign(eds_path(eds), mode, {node_id: position})
    command = bench.start("run", scene, *ON_VCAN0, "--out", "results", "--json")
    assert command.end(0) == []
    (seen,) = drives.end().values()
    assert_swung(seen, word)
    assert json.loads(command.out)["completed"] is True
