"""The nodes of a cell on two buses, end to end in lockstep; and a port over several buses by itself."""

import dataclasses

import numpy as np
import pytest
from cut_port import CutPort
from undrawn import undrawn_run

import canprobe
from canprobe.cell.master.controller import Command
from canprobe.cell.recorded.recording import read_recording
from canprobe.cell.session.session import Session
from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.joined import JoinedPort
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus, Participant
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of
from canprobe.fieldbus.protocol.frames import NmtState


def split_scene():
    scene = canprobe.load_scene("press", {"task.clearance_mm": 0.3, "cycle.rate_hz": 200.0})
    return dataclasses.replace(scene, sensor=dataclasses.replace(scene.sensor, mode="image", channel="can1"))


@pytest.fixture(scope="module")
def pressed(tmp_path_factory):
    out = tmp_path_factory.mktemp("split")
    return undrawn_run(split_scene(), out=out, duration_s=0.1), list(read_candump(out / "bus.log"))


def test_the_full_image_that_one_bus_could_not_carry_is_served_on_its_own(pressed):
    result, _ = pressed
    summary = result.summary
    assert summary["completed"] and not summary["faults"]
    assert summary["cycle"]["torn_frames"] == summary["cycle"]["missed_pdos"] == 0
    assert summary["contact"]["force_measured_rms_error_n"] < 0.1  # of 2 N
    loads = summary["bus_load"]
    assert list(loads) == ["can0", "can1"]
    assert all(0 < load["measured"] < load["planned_worst"] < 1 for load in loads.values())
    assert {name: report["as_planned"] for name, report in summary["traffic"].items()} == {"can0": True, "can1": True}


def assert_pdos_on_their_bus(result, frames):
    """And a recording of the log has each of them."""
    ids = {name: {frame[2] for frame in frames if frame[1] == name} for name in ("can0", "can1")}
    recording = read_recording(result.out / "bus.log", result.plan)
    assert len(recording.syncs) == sum(frame[1:3] == ("can0", 0x080) for frame in frames)
    for pdo in result.plan.pdos:
        assert [name for name in ids if pdo.cob_id in ids[name]] == [pdo.channel]
        assert sum(frame[0] == pdo.cob_id for frame in recording.frames) == sum(f[2] == pdo.cob_id for f in frames)
    return ids


def test_each_bus_has_its_own_nodes_and_every_bus_the_sync(pressed):
    result, frames = pressed
    assert np.all(np.diff([frame[0] for frame in frames]) >= 0), "lines of both buses are in the order of time"
    ids = assert_pdos_on_their_bus(result, frames)
    assert {0x590, 0x610, 0x710} <= ids["can1"] and not {0x590, 0x610, 0x710} & ids["can0"]
    assert {0x080, 0x000, 0x77F} <= ids["can0"] & ids["can1"]
    syncs = [[frame[3] for frame in frames if frame[1] == name and frame[2] == 0x080] for name in ids]
    assert syncs[0] == syncs[1]


class Answering(Participant):
    """Answers a frame by one of the next identifier, `delay_ns` later."""

    next_deadline_ns = None

    def __init__(self, delay_ns):
        self.delay_ns, self.answer = delay_ns, []

    def receive(self, can_id, data, t_ns):
        self.next_deadline_ns, self.answer = t_ns + self.delay_ns, [(can_id + 1, data)]
        return []

    def advance(self, t_ns):
        self.next_deadline_ns, answer = None, self.answer
        return answer


def test_a_joined_port_sends_where_a_frame_belongs_and_hears_all_in_order():
    clock = VirtualClock()
    buses = {"a": LockstepBus(clock, "a"), "b": LockstepBus(clock, "b")}
    buses["a"].attach(Answering(5_000_000))
    buses["b"].attach(Answering(3_000_000))
    joined = JoinedPort({name: bus.port() for name, bus in buses.items()}, {0x201: "a", 0x301: "b"})
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


def cut_session(scene, channel, lost_ns):
    """A session that loses one of its buses."""
    session = Session(scene)
    joined = session.buses._joined

    def cut(ports):
        return joined({**ports, channel: CutPort(ports[channel], lost_ns)})

    session.buses._joined = cut
    return session


def assert_drives_off(session):
    words = [node.dictionary.number(0x6041) for node in session.buses.world.nodes if node.node_id <= 7]
    assert not POWERED_STATES.intersection(map(state_of, words))


def hold(measurement):
    return Command(q_target=None if measurement.cycle else measurement.q)


def test_the_arm_is_stopped_by_its_master_when_the_sensors_bus_is_lost():
    """The bus that is left still carries SYNC and controlwords: no drive has to stop by itself, with an EMCY."""
    session = cut_session(split_scene(), "can1", 900_000_000)
    heard = []
    with pytest.raises(InterfaceError, match="can1: it is gone"), session:
        write = session.buses.lockstep.recorder

        def record(can_id, data, t_ns):
            heard.append((can_id, data, t_ns))
            write(can_id, data, t_ns)

        session.buses.lockstep.recorder = record
        session.run(hold)
    assert_drives_off(session)
    assert not [frame for frame in heard if 0x81 <= frame[0] <= 0x86]
    stops = [t for can_id, data, t in heard if can_id == 0x201 and t > 900_000_000 and data[0] & 0x06 == 0x02]
    assert stops and stops[0] < 910_000_000  # quick stop, within four cycles


@pytest.mark.parametrize(
    ("make_scene", "channel"),
    [(split_scene, "can0"), (lambda: spread_scene(canprobe.load_scene("free"), 3), "can1")],
    ids=["all drives", "three of them"],
)
def test_drives_whose_bus_is_lost_stop_by_themselves_and_all_nodes_of_the_other_one_are_let_go(make_scene, channel):
    session = cut_session(make_scene(), channel, 900_000_000)
    with pytest.raises(InterfaceError, match=f"{channel}: it is gone"), session:
        session.run(hold)
    assert_drives_off(session)
    on_lost_bus = {i for bus in session.plan.buses if bus.channel == channel for i in bus.node_ids}
    others = [node for node in session.buses.world.nodes if node.node_id not in on_lost_bus]
    assert {node.state for node in others} == {NmtState.PRE_OPERATIONAL}


def test_a_bus_that_is_lost_is_told_once_and_the_others_go_on():
    clock = VirtualClock()
    buses = {name: LockstepBus(clock, name) for name in ("a", "b")}
    for bus in buses.values():
        bus.attach(Answering(1_000_000))
    ports = {"a": CutPort(buses["a"].port(), 10_000_000), "b": buses["b"].port()}
    joined = JoinedPort(ports, {})
    clock.sleep_until_ns(10_000_000)
    with pytest.raises(InterfaceError, match="a: it is gone"):
        joined.send_batch([(0x080, b"")])
    joined.wait(20_000_000)
    assert joined.drain() == [(0x081, b"", 11_000_000)]  # b had the frame all the same
    joined.send_batch([(0x080, b"")])
    joined.wait(20_000_000)
    assert [frame[0] for frame in joined.drain()] == [0x081]
    joined.wait(20_000_000)
    assert clock.now_ns() == 20_000_000
    ports["b"].close()
    for _ in range(2):  # nothing is left: that is told again and again
        with pytest.raises(InterfaceError):
            joined.drain()


# The drives of one arm on two buses.


def spread_scene(scene, first):
    """A scene whose joints from `first` on, counted from 0, have a bus of their own."""
    joints = enumerate(scene.joints.items())
    return dataclasses.replace(
        scene,
        joints={k: dataclasses.replace(joint, channel="can1" if i >= first else None) for i, (k, joint) in joints},
    )


def test_seven_drives_on_two_buses_have_room_for_their_torque_and_the_array(tmp_path):
    keys = {"cell": "seven-axis", "task.clearance_mm": 0.3, "shape.also": []}
    result = undrawn_run(spread_scene(canprobe.load_scene("cylinder", keys), 4), out=tmp_path, duration_s=0.1)
    summary, plan = result.summary, result.plan
    assert plan.setup.arm.torque and plan.sync.period_ns == 2_500_000
    assert [(bus.channel, bus.node_ids) for bus in plan.buses] == [("can0", (1, 2, 3, 4, 16)), ("can1", (5, 6, 7))]
    assert summary["completed"] and not summary["faults"] and summary["cycle"]["missed_pdos"] == 0
    assert all(report["as_planned"] for report in summary["traffic"].values())
    assert_pdos_on_their_bus(result, list(read_candump(tmp_path / "bus.log")))


def test_the_controller_waits_for_the_slower_bus():
    """Two drives on one bus, five and the array on the other: one budget, that of the later feedback and commands."""
    plan = canprobe.plan(spread_scene(canprobe.load_scene("cylinder", {"cell": "seven-axis"}), 5))
    budget = plan.budget
    for what, direction in (("feedback_ns", "tpdo"), ("commands_ns", "rpdo")):
        of_drives = [p.response_ns for p in plan.pdos if p.kind == "drive" and p.direction == direction]
        assert getattr(budget, what) == max(of_drives)
    first = min(p.response_ns for p in plan.pdos if p.direction == "rpdo" and p.channel == "can1")
    assert first > budget.start_ns + budget.compute_ns


def test_targets_share_an_rpdo_only_with_a_drive_on_the_same_bus():
    scene = spread_scene(canprobe.load_scene("cylinder"), 3)
    plan = canprobe.plan(dataclasses.replace(scene, arm=dataclasses.replace(scene.arm, grouped_rpdo=True)))
    shared = {}
    for pdo in plan.pdos:
        if pdo.direction == "rpdo" and pdo.number == 2:
            shared.setdefault((pdo.channel, pdo.cob_id), []).append(pdo.node_id)
    assert sorted(shared.values()) == [[1, 2], [3], [4, 5], [6]]
