"""The monitor hears of a cell what the cell and the plant know of themselves, and sends nothing."""

from __future__ import annotations

import json
from dataclasses import replace

import can
import numpy as np
import pytest
from undrawn import undrawn_run

import canprobe
from canprobe import api
from canprobe.cell.master.monitor import Monitor, image_lines, lines, screen
from canprobe.cell.scene.load import load_scene
from canprobe.cli import main
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.protocol.emcy import Emcy

STEP_NS = 100_000_000


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A short press: its result, its frames, and the monitor at the end of the hold."""
    folder = tmp_path_factory.mktemp("press")
    result = undrawn_run(load_scene("press", {"cycle.rate_hz": 200.0}), out=folder, duration_s=0.3)
    frames = [(can_id, data, t_ns) for t_ns, _, can_id, data in read_candump(folder / "bus.log")]
    return result, frames


def heard(recorded, until_ns, change=lambda frames: frames):
    result, frames = recorded
    monitor = Monitor(result.plan)
    frames = [frame for frame in change(frames) if frame[2] <= until_ns]
    for start in range(0, until_ns, STEP_NS):
        monitor.push(f for f in frames if start <= f[2] < start + STEP_NS)
    return monitor.view(until_ns)


@pytest.fixture(scope="module")
def in_hold(recorded):
    result, frames = recorded
    row = int(np.flatnonzero(result.log["phase"] == 3)[-1]) - 1
    syncs = [t for can_id, _, t in frames if can_id == 0x080]
    return row, syncs[row], heard(recorded, syncs[row] + 1_000_000)


def test_what_is_shown_is_the_cell(recorded, in_hold):
    result, _ = recorded
    row, _, view = in_hold
    assert view.q == pytest.approx(np.degrees(result.truth["q_rad"][row]), abs=0.05)
    assert view.force_n == pytest.approx(result.log["force_n"][row], abs=0.1)
    assert view.taxels.max() > 50 and view.torn_frames == 0
    assert [n.node_id for n in view.nodes] == [1, 2, 3, 4, 5, 6, 16, 127]
    assert {n.state for n in view.nodes} == {"OPERATIONAL"}
    assert {n.drive for n in view.nodes[:6]} == {"OPERATION_ENABLED"}
    assert view.nodes[6].drive is None and max(n.heard_s for n in view.nodes) < 0.11


def test_load_and_sync(recorded, in_hold):
    result, frames = recorded
    _, t_ns, view = in_hold
    assert view.sync_hz == pytest.approx(200, abs=1)
    assert 0 < view.sync_jitter_us[1] < 135  # a SYNC waits for the frame on the wire
    last = [f for f in frames if t_ns + 1_000_000 - 1_000_000_000 <= f[2] <= t_ns + 1_000_000]
    assert view.frames_per_s == pytest.approx(len(last), abs=1)
    (load,) = view.load.values()
    assert 0.2 < load < result.plan.traffic.load


def test_a_silent_node_an_emergency_and_a_statusword_of_no_state_are_shown(recorded, in_hold):
    _, t_ns, _ = in_hold

    def trouble(frames):
        for can_id, data, t in frames:
            if can_id != 0x703 or t < 1_000_000_000:
                yield can_id, b"\x01" + data[1:] if can_id == 0x182 else data, t
        yield 0x084, Emcy(0x4310, 0x08).pack(), t_ns

    view = heard(recorded, t_ns + 1_000_000, lambda frames: sorted(trouble(frames), key=lambda frame: frame[2]))
    shown = {line.split("joint ")[1][0]: line for line in lines(view) if line.startswith("node ") and "joint " in line}
    assert "in no CiA 402 state (statusword 0x" in shown["2"] and "OPERATION_ENABLED" in shown["1"]
    assert "SILENT for" in shown["3"]
    assert "EMCY 4310h, drive over-temperature" in shown["4"]


def test_the_screen_is_plain_ansi_in_place(in_hold):
    _, _, view = in_hold
    text = screen(view)
    assert text.startswith("\x1b[H") and text.endswith("\x1b[J") and text.count("\r\n") == len(list(lines(view)))
    assert "node   1  joint 1        OPERATIONAL      OPERATION_ENABLED" in text
    assert json.loads(json.dumps(view.as_document()))["q"] == view.q


def test_the_image_is_the_right_way_round():
    taxels = np.zeros((16, 16), np.uint8)
    taxels[2, 5] = 200
    rows = list(image_lines(taxels))
    assert len(rows) == 16 and rows[2] == "  " + " " * 10 + "██" + " " * 20
    assert all(not row.strip() for i, row in enumerate(rows) if i != 2)


def on_two_buses():
    scene = load_scene("press")
    return replace(scene, sensor=replace(scene.sensor, channel="can1"))


def test_two_buses_are_heard_as_one_cell():
    """SYNC goes out on both and counts once; each bus has its own load."""
    monitor = Monitor(canprobe.plan(on_two_buses()))
    for k in range(400):
        sync = [(0x080, bytes([k % 240 + 1]), k * 2_500_000)]
        monitor.push([*sync, (0x705, b"\x05", k * 2_500_000 + 1000)], "can0")
        monitor.push(sync, "can1")
    monitor.push([(0x710, b"\x05", 999_000_000)], "can1")
    view = monitor.view(1_000_000_000)
    assert view.sync_hz == 400 and view.frames_per_s == 1201 and view.sync_jitter_us == (0.0, 0.0)
    assert view.load == {"can0": 0.044, "can1": 0.022055}, "47 bits of a frame, and 8 of its byte"
    assert {n.node_id for n in view.nodes if n.state == "OPERATIONAL"} == {5, 16}
    assert "can0+can1" in next(lines(view)) and "load can0  4.4 %, can1  2.2 %" in next(lines(view))


def test_the_command_listens_to_both_buses(capsys):
    """On python-can's own bus, which ends at the process: the heartbeats are waiting when the monitor opens."""
    buses = {name: can.Bus(interface="virtual", channel=name) for name in ("left", "right")}
    scene = on_two_buses()
    heard = iter(api.monitor(api.Target.over(scene, "virtual", {"can0": "left", "can1": "right"}).applied_to(scene)))
    next(heard)
    for name, node_id in (("left", 4), ("right", 16)):
        buses[name].send(can.Message(arbitration_id=0x700 + node_id, data=b"\x05", is_extended_id=False))
    view = next(heard)
    heard.close()
    for bus in buses.values():
        bus.shutdown()
    assert {n.node_id for n in view.nodes if n.state == "OPERATIONAL"} == {4, 16}


def test_nothing_heard_is_said_so():
    monitor = Monitor(canprobe.plan(load_scene("cylinder")))
    text = "\n".join(lines(monitor.view(0)))
    assert text.count("not heard") == 8 and "joints" not in text
    monitor.push([(0x181, b"\x00", 5), (0x701, b"", 6), (0x511, bytes(3), 7), (0x081, b"\1", 8)])
    assert monitor.view(10).q is None


def test_a_lockstep_bus_cannot_be_monitored(capsys):
    assert main(["monitor", "press"]) == 2
    assert "lockstep" in capsys.readouterr().err
