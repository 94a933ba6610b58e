"""Nodes on two interfaces: real and emulated ones side by side, and an arm whose emulated drives are on both."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from typing import Any

import pytest
from rights import type_as_root

from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.real.socketcan import SocketCanPort

pytestmark = pytest.mark.vcan
SECOND = "vcan7"
SCENE = """\
[scene]
name = "split"
[cycle]
rate_hz = 100
[arm]
emulated = false
missed_syncs = 40
[limits]
late_cycles_max_percent = 100
[sensor]
channel = "can1"
rate_hz = 50
mode = "image"
[object]
kind = "plane"
[task]
kind = "press"
"""


def delete(link: str) -> None:
    subprocess.run(["ip", "link", "del", link], capture_output=True, check=False)


@pytest.fixture
def second_bus() -> Iterator[SocketCanPort]:
    """An ear on a second virtual interface."""
    delete(SECOND)  # of a test that was killed
    for words in (("add", "dev", SECOND, "type", "vcan"), ("set", SECOND, "up")):
        type_as_root("ip", "link", *words)
    port = SocketCanPort(SECOND, MonotonicClock())
    yield port
    port.close()
    delete(SECOND)


@pytest.mark.slow(reason="two interfaces; in lockstep: tests/cell/integration/test_two_buses.py")
def test_an_arm_of_another_process_and_an_emulated_sensor_on_its_own_bus(bench: Any, second_bus: Any) -> None:
    arm = bench.start("emulate", "free", "--channel", "vcan0").until_told("serving nodes")
    scene = bench.folder / "split.toml"
    scene.write_text(SCENE)
    buses = ("--bus", "socketcan", "--channel", "can0=vcan0", "--channel", f"can1={SECOND}")
    command = bench.start("up", scene, *buses)
    bench.bus.until_enabled(6, by=command)
    second = second_bus.drain()
    images = {can_id for can_id, _, _ in second if 0x511 <= can_id <= 0x531}
    assert images == set(range(0x511, 0x532)), "the header and the 32 PDOs of an image"
    assert {0x080, 0x77F, 0x710} <= {can_id for can_id, _, _ in second}
    assert not {can_id for can_id, _, _ in second if 0x181 <= can_id <= 0x206}, "the arm's PDOs are on the other bus"
    command.send(signal.SIGINT)
    lines = command.end(0)
    assert not [line for line in lines if "bit rate" in line or "warning" in line], "a virtual bus has none"
    bench.bus.hear()
    last = {can_id: data for can_id, data, _ in second + second_bus.drain()}
    bench.assert_left_safe(bench.bus.last, 1, 2, 3, 4, 5, 6)
    assert last[0x710] == b"\x7f", "the sensor is pre-operational"
    assert not {can_id for can_id in bench.bus.last if 0x511 <= can_id <= 0x531}, "and was never on the arm's bus"
    assert arm.running


SPREAD = """\
[scene]
name = "spread"
[outputs]
figures = false
[cycle]
rate_hz = 100
[arm]
missed_syncs = 40
[limits]
late_cycles_max_percent = 100
[joints.joint_4]
channel = "can1"
[joints.joint_5]
channel = "can1"
[joints.joint_6]
channel = "can1"
[task]
kind = "free"
duration_s = 1
"""


@pytest.mark.slow(reason="two interfaces; in lockstep: tests/cell/integration/test_two_buses.py")
def test_emulated_drives_of_one_arm_on_two_interfaces(bench: Any, second_bus: Any) -> None:
    """One process serves both buses from one plant, and one master runs the arm over both."""
    scene = bench.folder / "spread.toml"
    scene.write_text(SPREAD)
    buses = ("--bus", "socketcan", "--channel", "can0=vcan0", "--channel", f"can1={SECOND}")
    bench.start("run", scene, *buses, "--out", bench.folder / "run").end(0)
    results = bench.results("run")
    assert results.summary["completed"]
    assert {name: load["measured"] > 0 for name, load in results.summary["bus_load"].items()} == {
        "vcan0": True,
        SECOND: True,
    }
    on = {name: {row[2] for row in results.frames if row[1] == name} for name in ("vcan0", SECOND)}
    tpdos, common = {0x180 + node_id for node_id in range(1, 7)}, {0x000, 0x080, 0x77F}
    assert on["vcan0"] & tpdos == {0x181, 0x182, 0x183} and on[SECOND] & tpdos == {0x184, 0x185, 0x186}
    assert common <= on["vcan0"] & on[SECOND]
    syncs = {name: [row[3] for row in results.frames if row[1] == name and row[2] == 0x080] for name in on}
    assert syncs["vcan0"] == syncs[SECOND]
    assert {frame[0] for frame in second_bus.drain()} >= {0x080, 0x184, 0x204}
    bench.assert_left_safe(results.last, 1, 2, 3, 4, 5, 6)
