"""The arm on one bus and the sensor on another, end to end in lockstep; and a port over several buses by itself."""

import dataclasses

import numpy as np
import pytest
from runs import undrawn_run

import canprobe
from canprobe.bus.candump import read_candump
from canprobe.bus.clock import VirtualClock
from canprobe.bus.joined import JoinedPort
from canprobe.bus.lockstep import LockstepBus
from canprobe.cell.recording import read_recording
from canprobe.errors import InterfaceError, UsageError
from canprobe.planning import make_plan


def split_scene():
    scene = canprobe.load_scene("press")
    return dataclasses.replace(scene, sensor=dataclasses.replace(scene.sensor, mode="image", channel="can1"))


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    out = tmp_path_factory.mktemp("split")
    return undrawn_run(split_scene(), out=out, duration_s=0.3), list(read_candump(out / "bus.log"))


def test_the_full_image_that_one_bus_could_not_carry_is_served_on_its_own(pressed):
    result, _ = pressed
    summary = result.summary
    assert summary["completed"] and not summary["faults"]
    assert summary["cycle"]["torn_frames"] == summary["cycle"]["missed_pdos"] == 0
    assert summary["contact"]["force_measured_rms_error_n"] < 0.1  # of 2 N
    loads = summary["bus_load"]
    assert list(loads) == ["can0", "can1"]
    assert all(0 < load["measured"] < load["planned_worst"] < 1 for load in loads.values())


def test_each_bus_has_its_own_nodes_and_every_bus_the_sync(pressed):
    _, frames = pressed
    ids = {name: {frame[2] for frame in frames if frame[1] == name} for name in ("can0", "can1")}
    plan = make_plan(split_scene())
    for pdo in plan.pdos:
        assert [name for name in ids if pdo.cob_id in ids[name]] == [pdo.channel]
    assert {0x590, 0x610, 0x710} <= ids["can1"] and not {0x590, 0x610, 0x710} & ids["can0"]
    assert {0x080, 0x000, 0x77F} <= ids["can0"] & ids["can1"]
    syncs = [[frame[3] for frame in frames if frame[1] == name and frame[2] == 0x080] for name in ids]
    assert syncs[0] == syncs[1]


def test_lines_of_both_buses_are_in_the_order_of_time(pressed):
    _, frames = pressed
    assert np.all(np.diff([frame[0] for frame in frames]) >= 0)


class Answering:
    """Answers a frame by one of the next identifier, `delay_ns` later."""

    def __init__(self, delay_ns):
        self.delay_ns, self.next_deadline_ns, self.answer = delay_ns, None, []

    def start(self, t_ns):
        return []

    def receive(self, can_id, data, t_ns):
        self.next_deadline_ns, self.answer = t_ns + self.delay_ns, [(can_id + 1, data)]
        return []

    def advance(self, t_ns):
        self.next_deadline_ns, answer = None, self.answer
        return answer


@pytest.fixture
def joined():
    clock = VirtualClock()
    buses = {"a": LockstepBus(clock, "a"), "b": LockstepBus(clock, "b")}
    buses["a"].attach(Answering(5_000_000))
    buses["b"].attach(Answering(3_000_000))
    return JoinedPort({name: bus.port() for name, bus in buses.items()}, {0x201: "a", 0x301: "b"})


def test_a_joined_port_sends_where_a_frame_belongs_and_hears_all_in_order(joined):
    joined.send_batch([(0x201, b"\x01"), (0x301, b"\x02")])
    assert joined.drain() == []
    joined.wait(100_000_000)
    assert joined.drain() == [(0x302, b"\x02", 3_000_000)]
    joined.wait(100_000_000)
    assert joined.drain() == [(0x202, b"\x01", 5_000_000)]
    joined.wait(7_000_000)
    assert joined.drain() == [] and joined.clock.now_ns() == 7_000_000
    joined.send_batch([(0x080, b"")])
    joined.clock.sleep_until_ns(20_000_000)
    assert [frame[0] for frame in joined.drain()] == [0x081, 0x081]
    assert (joined.channel, joined.stamps_arrival) == ("a+b", True)
    assert (joined.counters.sent, joined.counters.received) == (4, 4)
    joined.close()
    with pytest.raises(InterfaceError):
        joined.drain()


def test_emulated_nodes_on_two_real_buses_are_refused():
    scene = split_scene()
    scene = dataclasses.replace(scene, bus=dataclasses.replace(scene.bus, interface="socketcan"))
    with pytest.raises(UsageError, match="share one plant"):
        canprobe.run(scene, files=False)


def test_the_log_of_two_buses_is_read_as_the_one_the_cell_had(pressed):
    result, frames = pressed
    plan = result.plan
    recording = read_recording(result.out / "bus.log", plan, as_taken=False)
    main = [frame for frame in frames if frame[1] == "can0" and frame[2] == 0x080]
    assert len(recording.syncs) == len(main)
    for pdo in plan.pdos:
        assert sum(frame[0] == pdo.cob_id for frame in recording.frames) == sum(f[2] == pdo.cob_id for f in frames)


def test_each_bus_is_measured_against_its_own_part_of_the_plan(pressed):
    result, _ = pressed
    assert all(report["as_planned"] for report in result.summary["traffic"].values())
    assert set(result.summary["traffic"]) == {"can0", "can1"}
