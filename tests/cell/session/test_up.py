"""`up --check-joints` on the whole cell in lockstep, with drives that were set up wrongly."""

import json
import re
import struct
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
from scenes import change

import canprobe
import canprobe.api
from canprobe.cell.emulated.world import make_world
from canprobe.cell.master.controller import Command
from canprobe.cell.master.options import RunOptions
from canprobe.cell.session import up as joint_report
from canprobe.cell.session.buses import SessionBuses
from canprobe.cell.session.joint_record import JointRecord, warned
from canprobe.cell.session.session import Session
from canprobe.cell.session.up import reporting_notes
from canprobe.cell.tasks.joint_check import Answer, JointFinding, SeenWay
from canprobe.cli import main
from canprobe.errors import NodeError, SafetyStop, UsageError
from canprobe.fieldbus.node.dictionary import key_of
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of
from canprobe.fieldbus.protocol.emcy import Emcy
from canprobe.fieldbus.protocol.frames import EMCY_BASE, SYNC_ID
from canprobe.mechanics.robot.model import ArmModel, joints_to_units

REPORTED = "by its encoders the arm stands at"


class Hearing:
    """A drive that gets the data of each frame as a function of identifier and data gives them."""

    def __init__(self, node, change):
        self._node, self._change = node, change

    def __getattr__(self, name):
        return getattr(self._node, name)

    def receive(self, can_id, data, t_ns):
        return self._node.receive(can_id, self._change(can_id, data), t_ns)


class Watcher:
    """An operator who sees the true arm, in degrees or mm.

    At a degree he sees which joint moves and in which direction, and no gear. `only` are the joints that he lets move.
    """

    def __init__(self, only=None):
        self.session = self._before = None
        self._only, self._question = only, ""

    def ask(self, question, *, for_way=False):
        self._question, self._for_way = question, for_way

    def answer(self):
        plant = self.session.buses.world.plant
        prismatic = plant.config.model.chain.prismatic
        q = np.where(prismatic, 1e3, 180 / np.pi) * plant.truth()["q"]
        joint = int(re.search(r"joint (\d)", self._question)[1]) - 1
        if self._question.startswith("joint"):
            self._before = q
            return Answer.YES if self._only is None or joint in self._only else Answer.NO
        way = q - self._before
        others = np.delete(np.abs(way), joint).max()
        if self._for_way:
            return SeenWay(round(way[joint]))
        told = float(self._question.split("about ")[1].split()[0])
        return Answer.YES if way[joint] / told > 0.2 and others < 0.2 * abs(told) else Answer.NO


@pytest.fixture
def cell(monkeypatch):
    """Lets the session of a check join its nodes through a function; `cell.session` is that session afterwards."""

    class Opened:
        session, joins, operator, world = None, staticmethod(lambda participant: participant), None, None

    def make(*args, **more):
        Opened.session = Session(*args, **more)
        if Opened.world is not None:
            vars(Opened.session.buses)["world"] = Opened.world
        participants = Opened.session.buses.world.participants
        participants[:] = map(Opened.joins, participants)
        if Opened.operator is not None:
            Opened.operator.session = Opened.session
        return Opened.session

    monkeypatch.setattr(joint_report, "Session", make)
    monkeypatch.setattr(SessionBuses, "_need_emulated", lambda *_: None)  # real drives, as far as the cell can see
    return Opened


def on_node(node_id, change):
    return lambda one: change(one) if getattr(one, "node_id", None) == node_id else one


def flip(node):
    """Bit 7 of 607Eh: positions count the other way."""
    node.dictionary.values[key_of(0x607E)] = 0x80
    return node


def scene(cell="puma260", *, real=False):
    free = canprobe.load_scene("free", {"cell": cell, "cycle.rate_hz": 25.0, "bus.timed": False})
    return change(free, arm={"emulated": not real})


def true_world(scene, change_units=lambda units: units):
    """An arm whose motors are another one's, by their units.

    Where the arm stands its drives show what the cell file has there, as after zeros that were read at the marks.
    """
    plan = canprobe.plan(scene)
    arm, model = plan.setup.arm, plan.setup.arm.model
    units = change_units(np.array(model.units_per_q))
    zeros = joints_to_units(model, arm.q_start) - units @ arm.q_start
    truth = replace(plan.setup.truth, model=ArmModel(model.chain, model.joints, units, zeros))
    return make_world(replace(plan, setup=replace(plan.setup, truth=truth)), plan.node_ids)


def scaled(joint, factor):
    """The units of an arm of which one gear is another."""

    def change_units(units):
        units[joint, joint] *= factor
        return units

    return change_units


def assert_disabled(session):
    words = [node.dictionary.number(0x6041) for node in session.buses.world.nodes]
    assert not POWERED_STATES.intersection(map(state_of, words))


def test_drives_that_turn_the_wrong_way_are_named_by_their_encoders_or_by_who_watches(cell):
    """607Eh turns target and feedback round together: the arm moves the other way, and the numbers agree."""
    first = []

    def reverse(can_id, data):
        """Each way that it is told to go from its first target."""
        if can_id != 0x202:
            return data
        word, target = struct.unpack("<Hi", data)
        first.append(target)
        return struct.pack("<Hi", word, 2 * first[0] - target)

    wrong = {2: lambda node: Hearing(node, reverse), 3: flip}
    cell.joins = lambda one: wrong.get(getattr(one, "node_id", None), lambda node: node)(one)
    cell.operator, said = Watcher(), []
    told = (
        r"^node 2: \(joint 2\) it turned the wrong way;"
        r" node 3: \(joint 3\) the operator did not see it turn that way: polarity"
    )
    with pytest.raises(NodeError, match=told):
        canprobe.api.check_joints(scene(), operator=cell.operator, say=said.append)
    assert "joint 2 at 65.00 deg: asked +1.00 deg, turned -1.00 deg: it turned the wrong way" in said
    seen = "joint 3 at -15.00 deg: asked +1.00 deg, turned +1.00 deg: the operator did not see"
    assert any(line.startswith(seen) for line in said)
    assert sum("as expected" in line for line in said) == 4
    assert f"{REPORTED} 90.00, 65.00, -15.00," in said[-1], "and the pose is not the arm's"
    assert_disabled(cell.session)


def test_an_arm_that_says_that_it_is_outside_its_limits_is_not_moved(cell):
    cell.joins, said = on_node(5, flip), []
    with pytest.raises(SafetyStop, match=r"joint 5 stands at -100\.0 deg, outside -29\.0 to 199\.0 deg"):
        canprobe.api.check_joints(scene(), say=said.append)
    assert "q_target_rad" not in cell.session.cell.log.arrays()
    assert said[-1].startswith(f"{REPORTED} 90.00, 65.00, 15.00, 0.00, -100.00, ")
    assert_disabled(cell.session)


def test_an_interrupt_between_two_joints_disables_and_reports_what_was_done(cell):
    class Interrupting(Watcher):
        def answer(self):
            if self._question.startswith("joint 2"):
                raise KeyboardInterrupt
            return super().answer()

    cell.operator, said = Interrupting(), []
    with pytest.raises(KeyboardInterrupt):
        canprobe.api.check_joints(scene(), operator=cell.operator, say=said.append)
    assert re.match(r"joint 1 at 90.00 deg: asked -10.00 deg, turned -10.0\d deg, seen -\d+ deg: as expected", said[-2])
    assert_disabled(cell.session)


def test_a_right_arm_is_found_so(cell):
    cell.operator, cell.world, said = Watcher(), true_world(scene()), []
    findings = canprobe.api.check_joints(scene(), operator=cell.operator, say=said.append)
    assert [(f.fault, f.unseen, f.seen is None) for f in findings] == [(None, None, False)] * 6
    assert [f.moved for f in findings] == pytest.approx([-10.0, *[10.0] * 5], abs=0.03)
    assert said[-1].startswith(f"{REPORTED} 90.00, 65.00, 15.00, 0.00, 100.00, 0.")
    assert_disabled(cell.session)


def test_slides_are_checked_in_millimetres(cell):
    right = scene("gantry")
    cell.operator, cell.world = Watcher({0, 2}), true_world(right)
    seen = [f for f in canprobe.api.check_joints(right, operator=cell.operator) if f.seen is not None]
    assert [f.joint for f in seen] == [0, 2]
    assert [abs(f.asked) for f in seen] == pytest.approx([34.9] * 2, abs=0.01)
    cell.operator, cell.world = Watcher({2}), true_world(right, scaled(2, 2.0))
    with pytest.raises(NodeError, match=r"^node \d+: \(joint 3\) it \w+ 0\.\d+ times as far, as the operator"):
        canprobe.api.check_joints(right, operator=cell.operator)


# The record of real drives, which `plan`, `run` and `up` read.


@pytest.fixture
def state(tmp_path, monkeypatch):
    """File of the record, in a folder that is there."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    (tmp_path / "canprobe").mkdir()
    return tmp_path / "canprobe" / "joints-puma260.json"


def warning(scene):
    plan = canprobe.plan(scene)
    told = set(warned(plan).warnings) - set(plan.warnings)
    assert len(told) <= 1
    return told.pop() if told else None


def check_real(cell, scene, *, only=None, world=None):
    """What is said of a check of the joints of real drives."""
    cell.operator, cell.world, said = Watcher(only), world or true_world(scene), []
    canprobe.api.check_joints(scene, operator=cell.operator, say=said.append)
    return said


def test_a_check_of_real_drives_is_recorded_and_the_warning_ends(cell, state):
    real = scene(real=True)
    line = "before the first contact type: canprobe up free --check-joints --bus socketcan --channel can0"
    unknown = "whether the arm moves as its file says is not known: "
    assert warning(real) == f"{unknown}joints 1, 2, 3, 4, 5, 6 were not checked; {line}"
    assert check_real(cell, real, only={0, 2})[-1] == f"recorded in {state}: joints 1, 3"
    assert warning(real) == f"{unknown}joints 2, 4, 5, 6 were not checked; {line}"
    check_real(cell, real, only={1, 3, 4, 5})
    assert warning(real) is None
    entry = json.loads(state.read_text())["nodes"]["3"]
    assert datetime.fromisoformat(entry.pop("date")).tzinfo
    assert entry == {
        "seen": "+10 deg",
        "joint": "joint_3",
        "identity": [0xCA5E, 0x260],
        "serial": 3,
        "units": canprobe.plan(real).setup.arm.model.units_per_q[2].tolist(),
        "zero": [canprobe.plan(real).setup.arm.model.zero_units[2], None],
        "asked": "+10.00 deg",
        "array_n": None,
    }


def test_an_emulated_cell_is_neither_warned_nor_recorded(cell, state):
    assert warning(scene()) is None
    said = []
    cell.operator = Watcher({0})
    canprobe.api.check_joints(scene(), operator=cell.operator, say=said.append)
    assert not state.exists() and not any("record" in line for line in said)


@pytest.mark.parametrize(
    ("joint", "keys", "told"),
    [
        (2, {"gear": 30.0}, "joint 3 was checked with another counts, gear, sign or coupling"),
        (1, {"sign": -1}, "joint 2 was checked with another counts, gear, sign or coupling"),
        (4, {"zero_counts": 17}, "joint 5 was checked with another zero"),
        (0, {"serial_number": 4711}, r"joint 1 was checked with another drive \(1018h:04\)"),
        (3, {"node_id": 17}, "joint 4 was not checked"),
        (5, {"swing_deg": 3.0}, None),
    ],
)
def test_an_edit_of_the_cell_makes_its_joint_stale(state, checked, joint, keys, told):
    real = scene(real=True)
    state.write_text(checked)
    name = list(real.joints)[joint]
    edited = replace(real, joints={**real.joints, name: replace(real.joints[name], **keys)})
    if told is None:
        assert warning(edited) is None
    else:
        assert re.search(rf": {told}; before the first contact type", warning(edited))


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """A record of all joints of the cell."""
    plan, folder = canprobe.plan(scene(real=True)), tmp_path_factory.mktemp("state")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(folder))
        record = JointRecord(plan)
        for joint in range(6):
            record.put(JointFinding(joint, 0.0, 10.0, 10.0, seen="+10 deg"), {i: i for i in plan.node_ids})
        return record.path.read_text()


def test_an_exchanged_drive_is_noticed_once_the_nodes_are_up(cell, state, checked):
    real, said = scene(real=True), []
    state.write_text(checked.replace('"serial": 5', '"serial": 55'))
    assert warning(real) is None, "no cell file says which it has"
    session = Session(canprobe.plan(real), RunOptions(say=said.append))
    vars(session.buses)["world"] = true_world(real)
    with session:
        pass
    (line,) = [line for line in said if line.startswith("warning: whether")]
    assert "joint 5 was checked with another drive (1018h:04); before the first contact type" in line
    assert line.removeprefix("warning: ") in session.cell.notes.lines()


def test_a_joint_that_is_found_wrong_is_forgotten(cell, state, checked):
    real = scene(real=True)
    state.write_text(checked)
    told = r"^node 3: \(joint 3\) it turned 2\.\d+ times as far, as the operator saw it: gear, counts_per_turn"
    with pytest.raises(NodeError, match=told):
        check_real(cell, real, only={1, 2}, world=true_world(real, scaled(2, 0.5)))
    assert_disabled(cell.session)
    assert ": joint 3 was not checked; before" in warning(real)


def test_without_an_operator_nothing_is_recorded(cell, state):
    real, said = scene(real=True), []
    cell.world = true_world(real)
    findings = canprobe.api.check_joints(real, say=said.append)
    assert {f.asked for f in findings} == {-1.0, 1.0}
    assert said[-1] == "no joint is recorded: nobody has seen a larger way" and not state.exists()


@pytest.mark.parametrize("content", ["", "{", '{"schema": 1, "nodes": []}', '{"schema": 1, "nodes": {"1": 7}}'])
def test_a_record_that_cannot_be_read_counts_as_none(state, content):
    state.write_text(content)
    assert ": joints 1, 2, 3, 4, 5, 6 were not checked;" in warning(scene(real=True))


def test_a_record_of_a_newer_canprobe_is_said_and_refuses_no_run(cell, state, checked):
    state.write_text(checked.replace('"schema": 1', '"schema": 2'))
    assert "the file is of a newer canprobe" in warning(scene(real=True))
    with pytest.raises(UsageError, match="remove it, and check the joints again"):
        check_real(cell, scene(real=True))


def test_a_record_that_cannot_be_written_is_a_warning(cell, state):
    state.parent.rmdir()
    state.parent.write_text("a file where the folder should be")
    said = check_real(cell, scene(real=True), only={0})
    assert any(line.startswith(f"warning: {state.parent}: cannot be written") for line in said)


# The array is the second witness where the scene has one.


def test_what_presses_on_the_array_stops_the_joint_and_is_named(cell):
    """Joint 2 lowers the probe onto the cylinder 6 mm below it."""
    touching = canprobe.load_scene("press", {"cycle.rate_hz": 200.0, "bus.timed": False})
    forces, said = [], []

    def noting(can_id, data):
        if can_id == SYNC_ID:
            forces.append(cell.session.buses.world.plant.truth()["force"])
        return data

    cell.operator, cell.joins = Watcher({1}), on_node(1, lambda node: Hearing(node, noting))
    pressed = r"the array showed 0\.\d+ N while joint 2 moved alone, and it went back"
    with pytest.raises(SafetyStop, match=f"^{pressed}: move the arm away"):
        canprobe.api.check_joints(touching, operator=cell.operator, say=said.append)
    assert any(re.match(f"joint 2 at .*: {pressed}", line) for line in said)
    assert 0.15 < max(forces) < 2.0 and forces[-1] == 0.0
    assert_disabled(cell.session)


def test_an_array_of_which_no_image_changes_is_no_witness(cell):
    keys = {"cycle.rate_hz": 100.0, "sensor.rate_hz": 100.0, "bus.timed": False, "plant.noise": False}
    cell.operator = Watcher({5})
    findings = canprobe.api.check_joints(canprobe.load_scene("press", keys), operator=cell.operator)
    (finding,) = [one for one in findings if one.skipped is None]
    assert finding.seen is not None and finding.force is None


def test_a_scene_without_an_arm_is_refused():
    with pytest.raises(UsageError, match=r"scene listen has no \[arm\]"):
        canprobe.api.check_joints(canprobe.load_scene("listen"))


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("--check-joints",), "needs a terminal; --yes leaves that out"),
        (("--yes",), "--yes goes with --check-joints"),
        (("--check-joints", "--yes", "--recover"), "leave out --recover"),
        (("--check-joints", "--yes", "--bridge", "mcap"), "--check-joints feeds no --bridge"),
    ],
)
def test_a_wrong_command_line_is_one_clear_line(words, what, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin.isatty", lambda: False, raising=False)
    assert main(["up", "free", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert what in line


# `up` tells what it lives with: at once when it is new, counted at the end.


def test_each_kind_is_told_when_it_comes_and_counted_at_the_end():
    lines = []
    session = Session(canprobe.load_scene("free"))

    def disturb(measurement):
        if measurement.cycle in (60, 70):
            session.buses.lockstep.port().send_batch([(EMCY_BASE + 4, Emcy(0x8210, 0x11).pack())])
        return Command(done=measurement.cycle > 80)

    with reporting_notes(session, lines.append) as report_news:
        session.run(disturb, report_news)
        assert len(lines) == 1, "the second of the same kind is no news"
    what = "noted: node 4: EMCY 8210h, PDO not processed due to length error, "
    told = [re.findall(r"at ([\d.]+) s", line) for line in lines]
    start_s = session.cell.cycles.start_ns * 1e-9  # on the clock of bus.log
    first, last = (start_s + cycle * 0.0025 for cycle in (60, 70))
    assert [float(t) for times in told for t in times] == pytest.approx([first, first, last], abs=0.01)
    (one,), (start, end) = told
    assert lines == [what + f"at {one} s", what + f"2 times, first at {start} s, last at {end} s"]
