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


def test_each_bus_has_its_own_nodes_and_every_bus_the_sync(pressed):
    _, frames = pressed
    ids = {name: {frame[2] for frame in frames if frame[1] == name} for name in ("can0", "can1")}
    plan = canprobe.plan(split_scene())
    for pdo in plan.pdos:
        assert [name for name in ids if pdo.cob_id in ids[name]] == [pdo.channel]
    assert {0x590, 0x610, 0x710} <= ids["can1"] and not {0x590, 0x610, 0x710} & ids["can0"]
    assert {0x080, 0x000, 0x77F} <= ids["can0"] & ids["can1"]
    syncs = [[frame[3] for frame in frames if frame[1] == name and frame[2] == 0x080] for name in ids]
    assert syncs[0] == syncs[1]


def test_lines_of_both_buses_are_in_the_order_of_time(pressed):
    _, frames = pressed
    assert np.all(np.diff([frame[0] for frame in frames]) >= 0)


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


def test_the_log_of_two_buses_is_read_as_the_one_the_cell_had(pressed):
    result, frames = pressed
    plan = result.plan
    recording = read_recording(result.out / "bus.log", plan)
    main = [frame for frame in frames if frame[1] == "can0" and frame[2] == 0x080]
    assert len(recording.syncs) == len(main)
    for pdo in plan.pdos:
        assert sum(frame[0] == pdo.cob_id for frame in recording.frames) == sum(f[2] == pdo.cob_id for f in frames)


def test_each_bus_is_measured_against_its_own_part_of_the_plan(pressed):
    result, _ = pressed
    assert all(report["as_planned"] for report in result.summary["traffic"].values())
    assert set(result.summary["traffic"]) == {"can0", "can1"}


def cut_session(scene, channel, lost_ns):
    """A session that loses one of its buses."""
    session = Session(scene)
    joined = session.buses._joined

    def cut(ports):
        return joined({**ports, channel: CutPort(ports[channel], lost_ns)})

    session.buses._joined = cut
    return session


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
    words = [node.dictionary.number(0x6041) for node in session.buses.world.nodes if node.node_id <= 6]
    assert not POWERED_STATES.intersection(map(state_of, words))
    assert not [frame for frame in heard if 0x81 <= frame[0] <= 0x86]
    stops = [t for can_id, data, t in heard if can_id == 0x201 and t > 900_000_000 and data[0] & 0x06 == 0x02]
    assert stops and stops[0] < 910_000_000  # quick stop, within four cycles


def test_the_sensor_is_let_go_when_the_arms_bus_is_lost():
    session = cut_session(split_scene(), "can0", 900_000_000)
    with pytest.raises(InterfaceError, match="can0: it is gone"), session:
        session.run(hold)
    (sensor,) = [node for node in session.buses.world.nodes if node.node_id == 16]
    assert sensor.state is NmtState.PRE_OPERATIONAL
    words = [node.dictionary.number(0x6041) for node in session.buses.world.nodes if node.node_id <= 6]
    assert not POWERED_STATES.intersection(map(state_of, words))  # by themselves


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


@pytest.fixture(scope="module")
def seven(tmp_path_factory):
    out = tmp_path_factory.mktemp("seven")
    scene = spread_scene(
        canprobe.load_scene("cylinder", {"cell": "seven-axis", "task.clearance_mm": 0.3, "shape.also": []}), 4
    )
    return undrawn_run(scene, out=out, duration_s=0.1), list(read_candump(out / "bus.log"))


def test_seven_drives_on_two_buses_have_room_for_their_torque_and_the_array(seven):
    result, frames = seven
    summary, plan = result.summary, result.plan
    assert plan.setup.arm.torque and plan.sync.period_ns == 2_500_000
    assert [(bus.channel, bus.node_ids) for bus in plan.buses] == [("can0", (1, 2, 3, 4, 16)), ("can1", (5, 6, 7))]
    assert summary["completed"] and not summary["faults"] and summary["cycle"]["missed_pdos"] == 0
    assert summary["contact"]["contact_fraction"] == 1.0
    assert all(report["as_planned"] for report in summary["traffic"].values())
    assert not np.isnan(result.log["torque_permille"][-1]).any()
    ids = {name: {frame[2] for frame in frames if frame[1] == name} for name in ("can0", "can1")}
    for pdo in plan.pdos:
        assert [name for name in ids if pdo.cob_id in ids[name]] == [pdo.channel]


def test_a_recording_has_the_drives_of_both_buses(seven):
    result, frames = seven
    recording = read_recording(result.out / "bus.log", result.plan)
    for pdo in result.plan.pdos:
        assert sum(frame[0] == pdo.cob_id for frame in recording.frames) == sum(f[2] == pdo.cob_id for f in frames)


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
    free = spread_scene(canprobe.load_scene("free"), 3)
    free = dataclasses.replace(free, arm=dataclasses.replace(free.arm, grouped_rpdo=True))
    assert canprobe.run(free, files=False, duration_s=0.1).summary["completed"]


def test_the_arm_is_stopped_when_one_of_its_buses_is_lost():
    session = cut_session(spread_scene(canprobe.load_scene("free"), 3), "can1", 900_000_000)
    with pytest.raises(InterfaceError, match="can1: it is gone"), session:
        session.run(hold)
    words = [node.dictionary.number(0x6041) for node in session.buses.world.nodes]
    assert not POWERED_STATES.intersection(map(state_of, words))
