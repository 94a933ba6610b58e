"""Master and emulator in two processes on a real SocketCAN interface: bring-up and a touch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import canprobe
from canprobe.cell.planning.measured import expected_messages

pytestmark = pytest.mark.vcan
NODES = (1, 2, 3, 4, 5, 6, 16)
ON_VCAN0 = ("--bus", "socketcan", "--channel", "vcan0")


def test_a_touch_in_two_processes(bench: Any) -> None:
    scene = bench.scene("press")
    command = bench.start("run", scene, *ON_VCAN0, "--duration", 0.3, "--out", "results", "--json")
    bench.bus.until_booted(*NODES, by=command)
    (child,) = command.children
    assert command.end(0) == []
    results = bench.results("results")
    assert json.loads(command.out) == results.summary
    assert results.summary["bus"] == "socketcan"
    assert results.summary["completed"] is True
    assert all("8100h" in fault for fault in results.summary["faults"]), (
        "a late SYNC is told, nothing else may be wrong"
    )
    assert results.summary["contact"]["contact_fraction"] == 1.0
    assert results.summary["contact"]["force_max_n"] < 4.0
    assert 0.0 < results.summary["bus_load"]["vcan0"]["measured"] < 0.5
    bench.assert_left_safe(results.last, *NODES)
    assert not Path(f"/proc/{child}").exists()
    planned = canprobe.plan(canprobe.load_scene(scene))
    assert set(results.last) <= {can_id for bus in planned.buses for can_id in expected_messages(planned, bus)}
    assert {pdo.cob_id for pdo in planned.pdos} <= set(results.last)
    with np.load(bench.folder / "results" / "truth.npz") as truth:
        assert truth["force_n"].max() == pytest.approx(results.summary["contact"]["force_max_n"])
        at_nodes = truth["t_s"]
    with np.load(bench.folder / "results" / "log.npz") as log:
        due = log["t_s"]
    sent = np.array([t_ns * 1e-9 for t_ns, _, can_id, _ in results.frames if can_id == 0x080])
    assert len(sent) == len(at_nodes) and np.median(np.abs(at_nodes - sent)) < 2e-3, "one clock for both processes"
    assert np.median(np.abs(sent[: len(due)] - due)) < 2e-3, "and for every file"
