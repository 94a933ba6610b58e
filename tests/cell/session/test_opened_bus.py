"""A bus of python-can that its user has opened: scan, conform, judge and a cell work on it, and it stays open."""

from __future__ import annotations

import threading
import uuid
from contextlib import ExitStack, contextmanager

import can
import pytest

import canprobe
from canprobe.api import scan
from canprobe.fieldbus import MonotonicClock, load_eds, make_eds_node, open_port, serve
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.tools.conform import POINTS, Examination
from canprobe.fieldbus.tools.judge import Judge
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.reports import Verdict


@pytest.fixture
def buses():
    """Three that hear each other: for the nodes, for who talks to them, and for who listens."""
    channel = uuid.uuid4().hex
    with ExitStack() as stack:
        yield [stack.enter_context(can.Bus(interface="virtual", channel=channel)) for _ in range(3)]


def opened(bus: can.BusABC):
    return open_port(bus, "mine", 1_000_000, MonotonicClock())


@contextmanager
def served(bus: can.BusABC):
    """Node 5, served in a thread."""
    ended = threading.Event()
    nodes = [make_eds_node(load_eds("puma260_joint", 5), 5)]
    thread = threading.Thread(target=serve, args=([(nodes, opened(bus))], ended.is_set))
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def test_scan_conform_and_judge_work_on_it(buses):
    od = load_eds("puma260_joint", 5)
    with served(buses[0]):
        port = opened(buses[1])
        assert [node["node_id"] for node in scan(port)] == [5]
        port.close()
        points = [point for point in POINTS if point.number == 100]
        report = Examination(opened(buses[1]), 5, Description(od)).run(points)
        assert [row.verdict for row in report.rows] == [Verdict.PASS]
    heard = [BusFrame(t_ns, can_id, data) for can_id, data, t_ns in opened(buses[2]).drain()]
    judge = Judge({5: Description(od)}).hear(heard)
    assert judge.bus.nodes[5].addressed and judge.frame_count > 200
    buses[1].send(can.Message(arbitration_id=1))


def test_a_cell_is_brought_up_on_it(buses):
    scene = canprobe.load_scene("free")
    joints = {f"joints.{name}.emulated": False for name in scene.joints} | {"bring_up.boot_up_s": 0.2}
    with pytest.raises(canprobe.BusError, match="node 1"), canprobe.open_cell(scene, joints, bus=buses[1]):
        pass
    sent = [message.arbitration_id for message in iter(lambda: buses[0].recv(0), None)]
    assert sent and sent[0] == 0, "NMT reset, and no node answers"
    buses[1].send(can.Message(arbitration_id=1))


def test_a_cell_on_two_buses_needs_names(buses):
    scene = canprobe.load_scene("free")
    joints = {f"joints.{name}.emulated": False for name in scene.joints}
    first = next(iter(scene.joints))
    cell = canprobe.open_cell(scene, {**joints, f"joints.{first}.channel": "other"}, bus=buses[1])
    with pytest.raises(canprobe.UsageError, match="one of python-can was given, and the scene has 2"), cell:
        pass
