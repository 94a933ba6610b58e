"""An arm whose emulated drives are on two interfaces."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from typing import Any

import pytest
from rights import type_as_root

from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.real.socketcan import SocketCanPort

pytestmark = pytest.mark.vcan
SECOND = "vcan7"


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
