"""Homing by the master, on emulated drives that forget their zeros with the power: found, recorded, asked for."""

from __future__ import annotations

import json
import re
import struct
from dataclasses import replace

import numpy as np
import pytest
from judged import rules_raised
from makes import MAKES, Entry, changed, without, write_eds
from scenes import change, reasons, with_joints

import canprobe
from canprobe.cell.emulated.world import make_world
from canprobe.cell.master.cell import Cell
from canprobe.cell.master.controller import Command
from canprobe.cell.master.options import RunOptions
from canprobe.cell.plant.plant import Plant
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.joint_check import Answer
from canprobe.errors import CanprobeError, NodeError, UsageError
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus, Participant
from canprobe.fieldbus.eds.packaged import eds_path
from canprobe.fieldbus.protocol.cia402 import DriveState
from canprobe.fieldbus.protocol.frames import NmtCommand, pack_nmt
from canprobe.fieldbus.tools.faults import BUS_FAULTS, Fault, FaultyNode

HOMED = {"zero": "homing", "homing_acceleration_deg_s2": 1000.0, "homing_speed_deg_s": 100.0}
BEYOND = 0.01
"""Of its range, how far behind the end of a joint the limit switches of the plant are."""


WORD, MODE, SPEED = "2b406000", "2f606000", "23816000"
"""How writes of controlword, mode of operation and profile velocity begin."""


def switch(joint, method):
    """Where the switch of a method is, deg."""
    beyond = BEYOND * (joint.max_deg - joint.min_deg)
    return joint.min_deg - beyond if method in (1, 17) else joint.max_deg + beyond


def scene_of(methods, *, emulated=False, **keys):
    """A PUMA 260 whose joints are homed by the methods, from the base; 0: it has an absolute encoder."""
    scene = canprobe.load_scene("free", {"cycle.rate_hz": 200.0})
    joints = dict(scene.joints)
    for (name, joint), method in zip(scene.joints.items(), methods, strict=False):
        if method:
            home = joint.start_deg if method in (35, 37) else switch(joint, method)
            joints[name] = replace(joint, homing_method=method, home_deg=home, **{**HOMED, **keys})
    return change(replace(scene, joints=joints), arm={"emulated": emulated}, outputs={"figures": False})


def scene_of_make(make, folder, method, **keys):
    """A scene whose drives are of another make, at a rate that they take."""
    arm = {"eds": str(write_eds(make, folder)), "emulated": False}
    return change(scene_of([method], **keys), arm=arm, cycle={"rate_hz": 333.333})


class Answering:
    """A drive that answers as a function of it and a frame does."""

    def __init__(self, node, answer):
        self._node, self._answer = node, answer

    def __getattr__(self, name):
        return getattr(self._node, name)

    def receive(self, can_id, data, t_ns):
        return self._answer(self._node, can_id, data, t_ns)


class Bench:
    """Real drives, as far as the cell can see: on a bus that outlives the cells."""

    def __init__(self, scene, folder, *, faults=(), answer=None):
        self.plan = canprobe.plan(scene)
        self.bus = LockstepBus(VirtualClock(), "can0")
        self.world = make_world(self.plan, self.plan.node_ids, truth=False, homed=False)
        self.record = folder / "state" / "canprobe" / "zeros.json"
        self.heard, self.said = [], []
        self.bus.recorder = lambda *frame: self.heard.append(frame)
        for node in self.world.nodes:
            self.bus.attach(FaultyNode(node, faults) if faults else Answering(node, answer) if answer else node)

    @property
    def frames(self):
        return [frame[:2] for frame in self.heard]

    def cell(self, *, to_home=False):
        return Cell(self.plan, self.bus.port(), RunOptions(say=self.said.append, to_home=to_home), zeros=self.record)

    def home(self, *axes):
        with self.cell(to_home=True) as cell:
            return [cell.homing.home(axis) for axis in axes or cell.homing.order]

    def run(self):
        """The joints as the cell has them and as they are."""
        seen = []

        def controller(measurement):
            seen.append(measurement.q)
            return Command(done=True)

        with self.cell() as cell:
            cell.run(controller)
        return seen[-1], self.world.plant.truth()["q"]

    def written(self, node_id, request):
        """Values that a drive got by SDO, by the beginning of the request."""
        frames = [data for can_id, data in self.frames if can_id == 0x600 + node_id and data[:4].hex() == request]
        return [int.from_bytes(data[4:], "little") for data in frames]

    def states(self):
        return {node.application.state for node in self.world.nodes}


@pytest.mark.parametrize(("method", "end", "inward"), [(17, "min_deg", 1), (18, "max_deg", -1)])
def test_homed_joints_are_where_the_cell_has_them_stay_known_and_inside_their_range(tmp_path, method, end, inward):
    """A degree inside of where a run could begin, by a motion that has ended; or where one stands."""
    scene = scene_of([method, 35])
    bench = Bench(scene, tmp_path)
    assert all("is homed" in told for told in bench.home())
    stands = getattr(next(iter(scene.joints.values())), end) + inward * (scene.limits.joint_margin_deg + 1.0)
    assert np.degrees(bench.world.plant.truth()["q"][0]) == pytest.approx(stands, abs=0.05)
    assert [bench.written(node_id, MODE) for node_id in (1, 2)] == [[8, 6, 8, 1, 8], [8, 6, 8]]
    for _ in range(2):
        q, truth = bench.run()
        assert q == pytest.approx(truth, abs=2e-4)
    assert bench.states() == {DriveState.SWITCH_ON_DISABLED}
    resets = {data for can_id, data in bench.frames if can_id == 0}
    assert {pack_nmt(NmtCommand.RESET_COMMUNICATION, 1)[1], pack_nmt(NmtCommand.RESET_NODE, 3)[1]} <= resets
    assert pack_nmt(NmtCommand.RESET_NODE, 1)[1] not in resets
    assert rules_raised(bench.plan, bench.heard) == {}


def test_homing_leaves_a_drive_in_profile_position_as_quick_as_it_was(tmp_path):
    scene = change(scene_of([17]), arm={"eds": str(write_eds("no_cyclic_mode", tmp_path))})
    bench = Bench(scene, tmp_path)
    assert "inside its range" in bench.home()[0]
    wanted = [write.value for write in bench.plan.nodes[0].writes if write.index == 0x6081]
    written = bench.written(1, SPEED)
    assert written[0] == written[-1] == wanted[0] and len(written) == 3


def test_a_drive_without_a_home_offset_counts_zero_at_home(tmp_path):
    """An EPOS4 has no 607Ch. The plan names the zero_counts that the cell then needs, and with it homing is right."""
    eds = tmp_path / "no_home_offset.eds"
    eds.write_text(eds_path("puma260_joint").read_text().replace("607C", "5FFC"))
    scene = change(scene_of([17]), arm={"eds": str(eds)})
    (problem,) = reasons(scene)
    head, _, zero_counts = problem.rpartition(" = ")
    assert head.endswith("and the cell -23736: set joints.joint_1.zero_counts"), problem
    first = next(iter(scene.joints))
    joints = {**scene.joints, first: replace(scene.joints[first], zero_counts=int(zero_counts))}
    bench = Bench(replace(scene, joints=joints), tmp_path)
    bench.home()
    q, truth = bench.run()
    assert q[0] == pytest.approx(truth[0], abs=2e-4)
    (coupled,) = reasons(change(scene_of([0, 0, 0, 0, 17]), arm={"eds": str(eds)}))
    assert "depends on other joints: it cannot be homed" in coupled


def test_the_index_pulse_behind_the_positive_switch(tmp_path):
    """A joint whose motor turns once in 7.7 deg, and whose pulses count from the position at power on."""
    bench = Bench(scene_of([2]), tmp_path)
    bench.home()
    q, truth = bench.run()
    turn = np.radians(360 / 46.72) * 4096 / 1000
    assert 0 <= q[0] - truth[0] <= turn
    assert q[1:] == pytest.approx(truth[1:], abs=2e-4)


def test_a_slide_whose_drive_counts_backwards_finds_its_negative_switch_at_its_upper_end(tmp_path):
    scene = canprobe.load_scene("free", {"cell": "gantry"})
    x = replace(scene.joints["x"], sign=-1, zero="homing", homing_method=17, home_mm=404.0, homing_speed_mm_s=100.0)
    scene = replace(scene, joints={**scene.joints, "x": x})
    bench = Bench(change(scene, arm={"emulated": False}, outputs={"figures": False}), tmp_path)
    with bench.cell(to_home=True) as cell:
        assert "move in positive direction to the negative limit switch, at 100 and 2 mm/s" in cell.homing.question(0)
        told = cell.homing.home(0)
    assert told.startswith("joint 1 (x) is homed: home is at 404.00 mm; it stands at 39")
    q, truth = bench.run()
    assert q == pytest.approx(truth, abs=1e-5)
    assert 0.39 < q[0] < 0.4


QUESTIONS = {
    1: "move in negative direction to the index pulse at the negative limit switch, at 100 and 1 deg/s?",
    2: "move in positive direction to the index pulse at the positive limit switch, at 100 and 1 deg/s?",
    17: "move in negative direction to the negative limit switch, at 100 and 1 deg/s?",
    18: "move in positive direction to the positive limit switch, at 100 and 1 deg/s?",
    33: "move in negative direction to the next index pulse, at 100 and 1 deg/s?",
    34: "move in positive direction to the next index pulse, at 100 and 1 deg/s?",
    7: "move as its maker says, at 100 and 1 deg/s?",
    35: "take the place where it stands for 90.00 deg?",
    37: "take the place where it stands for 65.00 deg?",
}


@pytest.mark.parametrize("methods", [(1, 2, 17, 18, 33, 34), (35, 37, 7)], ids=str)
def test_the_operator_is_asked_what_the_joint_will_do(tmp_path, methods):
    bench = Bench(scene_of(methods), tmp_path)
    with bench.cell(to_home=True) as cell:
        asked = [cell.homing.question(axis) for axis in cell.homing.order]
    assert asked == [
        f"joint {i} (joint_{i}, node {i}): home it by method {method}: {QUESTIONS[method]}"
        for i, method in enumerate(methods, start=1)
    ]


def test_joints_in_their_order_each_alone_with_heartbeats_and_without_sync(tmp_path):
    bench = Bench(scene_of([35, 18, 35], homing_speed_deg_s=20.0), tmp_path)
    bench.home()
    enabled = [i - 0x600 for i, data in bench.frames if data[:5].hex() == "2b4060001f"]
    assert enabled == [1, 2, 3]
    assert 0x80 not in {can_id for can_id, _ in bench.frames}
    assert sum(can_id == 0x77F for can_id, _ in bench.frames) > 50


def test_a_coupled_wrist(tmp_path):
    """The motors of joints 5 and 6 stand in the forearm: what they count at home depends on the joints before them."""
    scene = scene_of([0, 0, 0, 18, 17, 18])
    bench = Bench(scene, tmp_path)
    bench.home()
    q, truth = bench.run()
    assert q == pytest.approx(truth, abs=1e-3)
    assert abs(truth[3]) > 0.5, "joint 4 is elsewhere than in the start posture"


def test_a_wrist_joint_waits_for_those_that_it_depends_on(tmp_path):
    bench = Bench(scene_of([0, 0, 0, 18, 17]), tmp_path)
    with pytest.raises(NodeError, match=r"node 5: \(joint 5\) cannot be homed: its zero depends on joint 4: home it"):
        bench.home(4)
    names = list(scene_of([]).joints)
    scene = scene_of([0, 0, 0, 18, 17])
    late = {name: replace(joint, homing_order=9 if name == names[3] else None) for name, joint in scene.joints.items()}
    late = {name: joint if joint.zero == "homing" else scene.joints[name] for name, joint in late.items()}
    (problem,) = reasons(replace(scene, joints=late))
    assert problem == (
        "the zero of joint_5 depends on joint_4, which is homed later: joints.joint_4.homing_order must be lower than 5"
    )


# Which drives are homed.


def refusal(bench):
    with pytest.raises(NodeError) as caught, bench.cell():
        pass
    return str(caught.value)


def test_what_makes_a_zero_worthless_and_a_run_be_refused_with_the_command(tmp_path):
    scene = scene_of([35] * 5)
    bench = Bench(scene, tmp_path)
    bench.home()
    assert bench.run()
    nodes, now_ns = bench.world.nodes, bench.bus.clock.now_ns()
    nodes[0].receive(0, pack_nmt(NmtCommand.RESET_NODE, 1)[1], now_ns)  # as by its power
    bench.world.plant.set_ramp(1, 0.0, 5000.0, now_ns, now_ns + 1)  # as by hand
    homes = [joint.home_deg for joint in scene.joints.values()]
    bench.plan = canprobe.plan(with_joints(scene, home_deg=[*homes[:2], homes[2] + 1.0, *homes[3:]]))
    nodes[3].dictionary.set_default(0x1018, 4, 4711)  # another drive
    assert refusal(bench) == (
        "node 1: (joint 1) is not homed, or was switched off or moved since; nor are 2 (joint 2), 3 (joint 3), 4"
        " (joint 4); type: canprobe home free --bus socketcan --channel can0"
    )
    bench.home(0, 1, 2)
    assert refusal(bench).startswith("node 4: (joint 4) is not homed, or was switched off or moved since; type: ")
    bench.home(3)
    assert bench.run()
    bench.record.write_text("{")
    assert refusal(bench).startswith("node 1: (joint 1) is not homed")


def test_the_record_names_what_homing_wrote_as_soon_as_the_joint_is_homed(tmp_path):
    bench = Bench(scene_of([35]), tmp_path)
    with bench.cell(to_home=True) as cell:
        cell.homing.home(0)
        ((node_id, entry),) = json.loads(bench.record.read_text())["nodes"].items()
    assert (node_id, entry["objects"]["6098h:00"]) == ("1", 35)
    assert entry["position"] == -entry["objects"]["607Ch:00"]


def test_a_run_records_where_it_leaves_a_joint(tmp_path):
    """Without it the next cell would take the motion of the run for one by hand."""
    bench = Bench(scene_of([35]), tmp_path)
    bench.home()

    def move(measurement):
        target = measurement.q + np.array([2e-3, 0, 0, 0, 0, 0])
        return Command(q_target=target, done=measurement.cycle > 60)

    with bench.cell() as cell:
        cell.run(move)
    before = json.loads(bench.record.read_text())["nodes"]["1"]
    q, truth = bench.run()
    assert q == pytest.approx(truth, abs=2e-4) and abs(before["position"] + before["objects"]["607Ch:00"]) > 40


def test_emulated_drives_of_a_run_start_homed_and_can_be_homed(capsys):
    scene = scene_of([0, 0, 0, 18, 17, 35], emulated=True)
    asked, said = [], []

    class Operator:
        def ask(self, question):
            asked.append(question)

        def answer(self):
            return [Answer.YES, Answer.NO, Answer.QUIT][len(asked) - 1]

    with Session(scene) as session:
        session.run(lambda _: Command(done=True))
    canprobe.api.home(scene, operator=Operator(), say=said.append)
    assert [question.partition(" (")[0] for question in asked] == ["joint 4", "joint 5", "joint 6"]
    assert sum("is homed" in line for line in said) == 1
    assert "joint 5 is left as it is" in said
    with pytest.raises(UsageError, match='no joint of free has zero = "homing"'):
        canprobe.api.home(canprobe.load_scene("free"))


# What goes wrong: the drive is stopped and disabled, and is not homed.


def failure(bench):
    with pytest.raises(NodeError) as caught:
        bench.home()
    assert bench.states() == {DriveState.SWITCH_ON_DISABLED}
    assert "is not homed" in refusal(bench)
    return str(caught.value)


def test_a_switch_that_is_never_found(tmp_path, monkeypatch):
    monkeypatch.setattr(Plant, "limit_switches", lambda *_: (-np.inf, np.inf))
    bench = Bench(scene_of([17], homing_timeout_s=5.0), tmp_path)
    assert failure(bench) == ("node 1: (joint 1) did not find its home position by method 17 in 5 s (homing_timeout_s)")
    assert bench.written(1, WORD)[-1] == 0x02
    assert "joint 1 is stopped and disabled; it is not homed" in bench.said


def test_a_homing_error_of_the_drive(tmp_path, monkeypatch):
    monkeypatch.setattr("canprobe.fieldbus.drive.homing.MAX_SEARCH_S", 0.5)
    bench = Bench(scene_of([17]), tmp_path)
    assert failure(bench) == (
        "node 1: (joint 1) could not find its home position by method 17: its statusword (6041h) has bit 13"
    )


def turned(node, can_id, data, t_ns):
    """It takes the home offset with the other sign."""

    def other_sign(frame):
        return frame[:4] + struct.pack("<i", -struct.unpack("<i", frame[4:])[0])

    answers = node.receive(can_id, other_sign(data) if data[:4].hex() == "237c6000" else data, t_ns)
    return [(i, other_sign(d) if d[1:4].hex() == "7c6000" and d[0] >> 5 == 2 else d) for i, d in answers]


def deaf(node, can_id, data, t_ns):
    """It confirms the command to enable operation and does not follow it."""
    if (can_id, data[:5].hex()) == (0x601, "2b4060000f"):
        return [(0x581, bytes.fromhex("6040600000000000"))]
    return node.receive(can_id, data, t_ns)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (
            turned,
            r"homed, but is at -(\d+) \(6064h\) where \1 was expected, with 607Ch = -\1: the drive may count the home"
            " offset the other way round",
        ),
        (deaf, r"is SWITCHED_ON \d+ s after the command for OPERATION_ENABLED"),
    ],
)
def test_a_drive_that_does_otherwise_than_it_confirms_is_named(tmp_path, answer, told):
    bench = Bench(scene_of([35]), tmp_path, answer=answer)
    assert re.fullmatch(rf"node 1: \(joint 1\) {told}", failure(bench))


def test_without_profile_position_the_joint_is_left_at_its_switch(tmp_path):
    make = MAKES["late_target"]()
    changed(make.objects, 0x6502, 0, default=1 << 7 | 1 << 5)
    bench = Bench(scene_of_make(make, tmp_path, 18, homing_speed_deg_s=60.0), tmp_path)
    (told,) = bench.home()
    assert told.endswith("it stands there, outside its range: move it inside by hand before a run")


def test_the_speed_of_the_way_back_is_written_in_the_unit_of_the_drive(tmp_path):
    """60A9h: revolutions a minute. The joint is homed at 90 deg/s, and its motor turns 46.72 times as often."""
    make = MAKES["late_target"]()
    make.objects[0x60A9, 0] = Entry("SI unit velocity", "U32", "ro", 0x00B4_4700)
    scene = scene_of_make(make, tmp_path, 18, homing_speed_deg_s=90.0)
    bench = Bench(scene, tmp_path)
    bench.home()
    assert bench.written(1, SPEED) == [round(90 / 360 * 60 * scene.joints["joint_1"].gear)]


def test_a_drive_whose_position_window_is_switched_off_is_inside_its_range_in_the_next_run(tmp_path):
    """6067h = FFFFFFFFh: where bit 10 is believed before the joint is there, the run's first target is 8612h."""
    make = MAKES["late_target"]()
    make.objects[0x6067, 0] = Entry("Position window", "U32", "rw", 0xFFFF_FFFF)
    bench = Bench(scene_of_make(make, tmp_path, 17), tmp_path)
    (told,) = bench.home()
    assert told.endswith("it stands at -178.00 deg, inside its range")
    q, truth = bench.run()
    assert q == pytest.approx(truth, abs=2e-4) and np.degrees(q[0]) == pytest.approx(-178.0, abs=0.05)


def test_a_drive_that_was_out_of_sight_is_not_homed_whatever_it_says(tmp_path):
    bench = Bench(scene_of([35, 35]), tmp_path)
    bench.home()
    cell = bench.cell()
    cell.doubted = frozenset({1})
    with pytest.raises(NodeError, match=r"node 1: \(joint 1\) is not homed.* since; type:"):
        cell.__enter__()
    assert json.loads(bench.record.read_text())["nodes"].keys() == {"2"}
    assert refusal(bench).startswith("node 1: (joint 1) is not homed")


class Once(Participant):
    """Does something when a drive starts to home."""

    listens = (0x601,)

    def __init__(self, act):
        self._act = act

    def receive(self, can_id, data, t_ns):
        if data[:5].hex() == "2b4060001f":
            self._act()
        return []


def test_ctrl_c_stops_and_disables_the_drive(tmp_path):
    bench = Bench(scene_of([17], homing_speed_deg_s=10.0), tmp_path)

    def interrupt():
        raise KeyboardInterrupt

    bench.bus.attach(Once(interrupt))
    with pytest.raises(KeyboardInterrupt):
        bench.home()
    assert bench.states() == {DriveState.SWITCH_ON_DISABLED}
    before = bench.world.plant.truth()["q"]
    assert "is not homed" in refusal(bench)
    assert bench.world.plant.truth()["q"] == pytest.approx(before, abs=1e-6)


@pytest.mark.parametrize("state", [DriveState.SWITCH_ON_DISABLED, DriveState.QUICK_STOP_ACTIVE, DriveState.SWITCHED_ON])
def test_a_drive_that_leaves_operation_while_homing_is_noticed(tmp_path, state):
    """As by its enable input: no EMCY, no homing error, and a heartbeat as always."""
    bench = Bench(scene_of([17], homing_speed_deg_s=10.0), tmp_path)
    drive = bench.world.nodes[0].application
    bench.bus.attach(Once(lambda: drive._go(state, bench.bus.clock.now_ns())))
    told = failure(bench)
    assert told == f"node 1: (joint 1) could not find its home position by method 17: it is {state.name}"


def test_a_record_is_gone_before_the_drive_moves(tmp_path):
    """Whatever happens then, up to a power cut of the master: the zero that it had is not taken for the new one."""
    bench = Bench(scene_of([17]), tmp_path)
    bench.home()
    kept = []
    bench.bus.attach(Once(lambda: kept.append(json.loads(bench.record.read_text())["nodes"])))
    bench.home()
    assert kept == [{}] and json.loads(bench.record.read_text())["nodes"].keys() == {"1"}


def test_a_drive_in_no_known_state_is_given_no_voltage_before_it_is_homed(tmp_path):
    odd = iter([b"\x01\x06"] * 2)

    def answer(node, can_id, data, t_ns):
        answers = node.receive(can_id, data, t_ns)
        if (can_id, data[:4].hex()) == (0x601, "40416000"):
            return [(i, d[:4] + next(odd, d[4:6]) + d[6:]) for i, d in answers]
        return answers

    bench = Bench(scene_of([35]), tmp_path, answer=answer)
    bench.home()
    assert bench.written(1, WORD)[:3] == [0x00, 0x00, 0x06]


def test_a_drive_that_does_not_say_where_it_is_left_keeps_no_record_and_the_others_theirs(tmp_path):
    bench = Bench(scene_of([35, 35]), tmp_path)
    bench.home()
    before = json.loads(bench.record.read_text())["nodes"]
    with bench.cell() as cell:
        cell.run(lambda m: Command(q_target=m.q + np.array([2e-3, 2e-3, 0, 0, 0, 0]), done=m.cycle > 60))
        bench.world.nodes[0].dictionary.entries.pop(0x101801)
    after = json.loads(bench.record.read_text())["nodes"]
    assert before["1"] == after["1"] and before["2"] != after["2"]
    left = "while stopping: node 1: (joint 1) read of 1018h:01 failed"
    assert any(fault.startswith(left) for fault in cell.notes.lines())


def test_another_master_that_comes_while_homing_is_named(tmp_path):
    bench = Bench(scene_of([17], homing_speed_deg_s=10.0), tmp_path)
    bench.bus.attach(Once(lambda: bench.bus.port().send_batch([pack_nmt(NmtCommand.STOP, 1)])))
    with pytest.raises(CanprobeError, match="an NMT command from another master"):
        bench.home()


def test_a_node_that_is_lost_stops_the_joint_that_is_homed(tmp_path):
    fault = Fault(BUS_FAULTS["mute"], 3, 3_000_000_000, 10_000_000_000)
    bench = Bench(scene_of([17], homing_speed_deg_s=10.0), tmp_path, faults=(fault,))
    with pytest.raises(NodeError, match="node 3: lost: no heartbeat within its time-out"):
        bench.home()
    assert bench.world.nodes[0].application.state is DriveState.SWITCH_ON_DISABLED


# What the plan refuses.


@pytest.mark.parametrize(
    ("change_objects", "told"),
    [
        (
            lambda o: changed(o, 0x6098, 0, low=-4, high=14),
            "6098h:00 = 17 (homing method) is needed: it takes -4 to 14",
        ),
        (lambda o: without(o, 0x6098), "6098h:00 = 17 (homing method) is needed: no such object"),
        (lambda o: without(o, 0x6099), "(speed of the search for the switch) is needed: no such object"),
        (lambda o: changed(o, 0x607C, 0, access="ro"), "(home offset) is needed: it is ro"),
        (lambda o: changed(o, 0x6502, 0, default=1 << 7), "needed: homing (6)"),
    ],
)
def test_a_drive_that_cannot_be_homed_is_refused_with_what_it_has(tmp_path, change_objects, told):
    make = MAKES["late_target"]()
    changed(make.objects, 0x6502, 0, default=1 << 7 | 1 << 5)
    change_objects(make.objects)
    assert any(told in problem for problem in reasons(scene_of_make(make, tmp_path, 17)))
