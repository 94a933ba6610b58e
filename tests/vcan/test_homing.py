"""Drives that forget their zeros with the power, in a process of their own: refused, homed, run, and known again."""

from __future__ import annotations

import json
from typing import Any

import pytest

pytestmark = pytest.mark.vcan
ON_VCAN0 = ("--bus", "socketcan", "--channel", "vcan0")
HOMED = """
[joints.joint_1]
zero = "homing"
homing_method = 18
home_deg = 112.9
homing_speed_deg_s = 20
homing_acceleration_deg_s2 = 200
swing_deg = 0.5

[joints.joint_6]
zero = "homing"
homing_method = 35
home_deg = 0
"""


@pytest.mark.slow(reason="homing of a cell and two runs on a real bus")
def test_a_run_after_homing(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(bench.folder / "state"))
    scene = bench.scene("free", emulated=False)
    scene.write_text(scene.read_text() + HOMED)
    served = bench.start("emulate", scene, "--channel", "vcan0", "--nodes", "1-6").until_told("serving nodes")
    line = bench.start("run", scene, *ON_VCAN0, "--out", "early").end(3)[-1]
    assert line == (
        "canprobe: node 1: (joint 1) is not homed, or was switched off or moved since; nor are 6 (joint 6); type:"
        f" canprobe home {scene} --bus socketcan --channel vcan0"
    )
    told = bench.start("home", scene, *ON_VCAN0, "--yes").end(0)
    assert "joint 6 (joint_6) is homed: home is at 0.00 deg; it stands there" in told
    record = bench.folder / "state" / "canprobe" / "zeros-puma260.json"
    assert list(json.loads(record.read_text())["nodes"]) == ["1", "6"]
    for out in ("once", "again"):
        assert bench.start("run", scene, *ON_VCAN0, "--duration", 0.5, "--out", out).end(0) == []
    bench.assert_left_safe(bench.results("again").last, *range(1, 7))
    assert served.running
