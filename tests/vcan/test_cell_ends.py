"""Every way out of a cell on a real interface: interrupts, nodes that die or never were there, other masters."""

from __future__ import annotations

import os
import re
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from canprobe.cli import main

pytestmark = pytest.mark.vcan
NODES = (1, 2, 3, 4, 5, 6, 16)
ON_VCAN0 = ("--bus", "socketcan", "--channel", "vcan0")


@pytest.mark.parametrize(
    ("name", "cycles", "number", "status"),
    [
        ("press", 150, signal.SIGINT, 130),
        pytest.param("free", 50, signal.SIGTERM, 143, marks=pytest.mark.slow(reason="the other signal on a real bus")),
    ],
)
def test_an_interrupt_in_mid_run(bench: Any, name: str, cycles: int, number: int, status: int) -> None:
    command = bench.start("run", bench.scene(name), *ON_VCAN0, "--out", "results")
    bench.bus.until_enabled(6, by=command, cycles=cycles)
    command.send(number)
    assert command.end(status) == ["canprobe: interrupted, the cell is stopped; results until then: results"]
    results = bench.results("results")
    assert (results.summary["completed"], results.summary["stop_reason"]) == (False, "interrupted")
    assert results.summary["cycle"]["cycles"] >= cycles
    bench.assert_left_safe(results.last, *NODES[: 7 if name == "press" else 6])
    with np.load(bench.folder / "results" / "truth.npz") as truth:
        assert len(truth["t_s"]) >= cycles
        steps = np.abs(np.diff(truth["q_rad"], axis=0)).max(axis=1)
        assert steps[-1] < 0.3 * steps.max(), "the arm comes to rest"
        if name == "press":
            assert truth["force_n"].max() > 1.0, "it was in contact"
            assert truth["force_n"][-1] == 0.0, "and was taken off"
            assert any(fault.startswith("lift off, at ") for fault in results.summary["faults"])


@pytest.mark.slow(reason="a killed process on a real bus; the default kills a node and a master")
def test_the_emulator_is_killed_in_mid_scan(bench: Any) -> None:
    (bench.folder / "results").mkdir()
    (bench.folder / "results" / "truth.npz").write_text("of an earlier run")
    command = bench.start("run", bench.scene("cylinder"), *ON_VCAN0, "--out", "results", "--force")
    bench.bus.until_enabled(6, by=command, cycles=300)
    (child,) = command.children
    os.kill(child, signal.SIGKILL)
    (line,) = command.end(3)
    # all are dead at once; whose heartbeat was the oldest depends on the instant
    assert re.match(rf"canprobe: node ({'|'.join(map(str, NODES))}): lost: ", line)
    results = bench.results("results")
    assert results.summary["completed"] is False
    assert results.summary["stop_reason"] == line.removeprefix("canprobe: ")
    assert results.summary["cycle"]["missed_pdos"] >= 6 * 6
    assert not (bench.folder / "results" / "truth.npz").exists(), "the truth died with the emulator"


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


@pytest.mark.parametrize(
    ("frame", "what"),
    [
        ((0x77F, b"\x05"), "a heartbeat of node 127"),
        pytest.param((0x080, b"\x01"), "SYNC", marks=pytest.mark.slow(reason="the other sign on a real bus")),
    ],
)
def test_another_master_is_at_work(bench: Any, frame: tuple[int, bytes], what: str) -> None:
    command = bench.start("run", bench.scene("free", emulated=False), *ON_VCAN0, "--out", "results")
    heard = []
    while command.running:
        bench.bus.port.send_batch([frame])
        heard += bench.bus.hear()
    (line,) = command.end(3)
    assert heard + bench.bus.hear() == [], "it has sent nothing"
    assert line.startswith(f"canprobe: vcan0: {what}")
    assert line.endswith("another master is at work here; stop it first")


@pytest.mark.parametrize(
    "words",
    [("run", "press", "--bus", "socketcan", "--channel", "vcan7"), ("emulate", "press", "--channel", "vcan7")],
)
def test_an_interface_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(list(words)) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("canprobe: vcan7: no such interface; type: ")
    assert "ip link add dev vcan7 type vcan" in line
    assert not (tmp_path / "runs").exists()
