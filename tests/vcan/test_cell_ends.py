"""Every way out of a cell on a real interface: interrupts, nodes that die or never were there, other masters."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from canprobe.cli import main

pytestmark = pytest.mark.vcan
NODES = (1, 2, 3, 4, 5, 6, 16)
ON_VCAN0 = ("--bus", "socketcan", "--channel", "vcan0")


def test_an_interrupt_in_mid_run(bench: Any) -> None:
    command = bench.start("run", bench.scene("press"), *ON_VCAN0, "--out", "results")
    bench.bus.until_enabled(6, by=command, cycles=150)
    command.send(signal.SIGINT)
    assert command.end(130) == ["canprobe: interrupted, the cell is stopped; results until then: results"]
    results = bench.results("results")
    assert (results.summary["completed"], results.summary["stop_reason"]) == (False, "interrupted")
    assert results.summary["cycle"]["cycles"] >= 150
    bench.assert_left_safe(results.last, *NODES)
    with np.load(bench.folder / "results" / "truth.npz") as truth:
        assert len(truth["t_s"]) >= 150
        steps = np.abs(np.diff(truth["q_rad"], axis=0)).max(axis=1)
        assert steps[-1] < 0.3 * steps.max(), "the arm comes to rest"
        assert truth["force_n"].max() > 1.0, "it was in contact"
        assert truth["force_n"][-1] == 0.0, "and was taken off"
        assert any(fault.startswith("lift off, at ") for fault in results.summary["faults"])


def test_one_node_is_killed(bench: Any) -> None:
    scene = bench.scene("free")
    five = bench.start("emulate", scene, "--channel", "vcan0", "--nodes", "1,2,4-6")
    third = bench.start("emulate", scene, "--channel", "vcan0", "--nodes", "3")
    bench.bus.until_booted(*NODES[:6], by=five)
    command = bench.start("run", bench.scene("free", emulated=False), *ON_VCAN0, "--out", "killed")
    bench.bus.until_enabled(6, by=command, cycles=20)
    third.send(signal.SIGKILL)
    (line,) = command.end(3)
    assert line.startswith("canprobe: node 3: lost: ")
    results = bench.results("killed")
    assert results.summary["stop_reason"] == line.removeprefix("canprobe: ")
    bench.assert_left_safe(results.last, 1, 2, 4, 5, 6)

    five.send(signal.SIGTERM)
    five.end(143)


@pytest.mark.slow(reason="a second killed master; the default kills that of test_cell_served.py")
def test_emulated_nodes_go_with_a_master_that_is_killed(bench: Any) -> None:
    command = bench.start("up", bench.scene("free"), *ON_VCAN0)
    bench.bus.until_enabled(1, by=command)
    (child,) = command.children
    command.send(signal.SIGKILL)
    while Path(f"/proc/{child}").exists():
        bench.bus.hear()


def test_another_master_is_at_work(bench: Any) -> None:
    command = bench.start("run", bench.scene("free", emulated=False), *ON_VCAN0, "--out", "results")
    heard = []
    while command.running:
        bench.bus.port.send_batch([(0x77F, b"\x05")])
        heard += bench.bus.hear()
    (line,) = command.end(3)
    assert heard + bench.bus.hear() == [], "it has sent nothing"
    assert line.startswith("canprobe: vcan0: a heartbeat of node 127")
    assert line.endswith("another master is at work here; stop it first")


def test_an_interface_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["run", "press", "--bus", "socketcan", "--channel", "vcan7"]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("canprobe: vcan7: no such interface; type: ")
    assert "ip link add dev vcan7 type vcan" in line
    assert not (tmp_path / "runs").exists()
