"""Supervision on a real interface: it goes down in mid-run, the emulator stands still, the disk is full."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from typing import Any

import pytest
from rights import type_as_root
from waiting import wait_until

pytestmark = pytest.mark.vcan
ON_VCAN0 = ("--bus", "socketcan", "--channel", "vcan0")


def link(state: str) -> None:
    type_as_root("ip", "link", "set", "vcan0", state)


@pytest.mark.slow(reason="a run on a real bus; the default takes down that of a port: test_socketcan.py")
def test_the_interface_goes_down_in_mid_run(bench: Any) -> None:
    command = bench.start("run", bench.scene("free"), *ON_VCAN0, "--out", "results")
    bench.bus.until_enabled(6, by=command, cycles=60)
    bench.bus.port.close()
    try:
        link("down")
        lines = command.end(3)
    finally:
        link("up")
    assert any("vcan0" in line and ("down" in line or "lost" in line) for line in lines), lines
    results = bench.results("results")
    assert results.summary["completed"] is False
    assert any("while stopping" in fault for fault in results.summary["faults"])


@pytest.mark.slow(reason="a stopped process on a real bus; the default kills one")
def test_the_emulator_stands_still_and_the_drives_are_lost(bench: Any) -> None:
    command = bench.start("run", bench.scene("free"), *ON_VCAN0, "--out", "results")
    bench.bus.until_enabled(6, by=command, cycles=60)
    (child,) = command.children
    os.kill(child, signal.SIGSTOP)
    try:
        (line,) = command.end(3)
    finally:
        with contextlib.suppress(ProcessLookupError):  # the cell has woken and ended it
            os.kill(child, signal.SIGCONT)
    assert (bench.folder / "results" / "truth.npz").exists(), "a process that is woken writes down what was true"
    assert "lost: no usable TPDO" in line or "lost: no heartbeat" in line  # at 100 Hz both come within 250 ms


@pytest.mark.slow(reason="a full disk on a real bus; without one in tests/cli/test_full_disk.py")
def test_the_disk_is_full(bench: Any) -> None:
    small = bench.folder / "small"
    small.mkdir()
    type_as_root("mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(small))
    try:
        command = bench.start("run", bench.scene("free"), *ON_VCAN0, "--out", "small/results")
        lines = command.end(3)
        assert any("small/results/" in line and "No space left" in line for line in lines)
        text = (small / "results" / "bus.log").read_text()
        assert text.endswith("\n") and text.count("\n") > 1000
        bench.bus.hear()
        bench.assert_left_safe(bench.bus.last, *range(1, 7))
    finally:
        type_as_root("umount", str(small))


@pytest.mark.slow(reason="a cell and a monitor on a real bus")
def test_monitor_sees_the_cell_and_sends_nothing(bench: Any) -> None:
    command = bench.start("up", bench.scene("free"), *ON_VCAN0)
    bench.bus.until_enabled(1, by=command)
    monitor = bench.start("monitor", bench.scene("free"), *ON_VCAN0, "--duration", "2", "--json")
    monitor.end(0)
    view = json.loads(monitor.out)
    assert {node["state"] for node in view["nodes"]} == {"OPERATIONAL"}
    assert {node["drive"] for node in view["nodes"][:6]} == {"OPERATION_ENABLED"}
    assert 50 < view["sync_hz"] < 110 and view["q"][0] == pytest.approx(90, abs=0.1)
    command.send(signal.SIGINT)
    command.end(0)


@pytest.mark.slow(reason="two recoveries on a real bus")
def test_a_cell_that_recovers_outlives_a_power_cycle_and_an_interface_that_was_down(bench: Any) -> None:
    command = bench.start("up", bench.scene("free"), *ON_VCAN0, "--recover", "--verbose")
    command.until_told("the cell is up")
    thrown = bench.start("inject", "--channel", "vcan0", "node 3: reboot for 2 s")
    thrown.end(0)
    command.until_told("lost: node 3").until_told("wait: node 3 not there").until_told("the cell is back after")
    bench.bus.until_enabled(3, by=command)
    bench.bus.port.close()
    link("down")
    command.until_told("wait: vcan0: interface is down")
    link("up")
    wait_until(lambda: command.err.count("the cell is back after") == 2, lambda: command.running, lambda: command.err)
    bench.bus = type(bench.bus)()
    bench.bus.until_enabled(6, by=command)
    command.send(signal.SIGINT)
    command.end(0)
    while bench.bus.hear():
        pass
    bench.assert_left_safe(bench.bus.last, 1, 2, 3, 4, 5, 6)
