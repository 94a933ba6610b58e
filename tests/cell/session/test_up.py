"""`up --check-joints` on the whole cell in lockstep, with drives that were set up wrongly."""

import re
import struct
from dataclasses import replace

import numpy as np
import pytest

import canprobe
import canprobe.api
from canprobe.cell.master.controller import Command
from canprobe.cell.session import check_joints as joint_report
from canprobe.cell.session.session import Session
from canprobe.cell.session.up import reporting_notes
from canprobe.cell.tasks.joint_finding import Answer
from canprobe.cli import main
from canprobe.errors import NodeError, SafetyStop, UsageError
from canprobe.fieldbus.node.entry import key_of
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of
from canprobe.fieldbus.protocol.emcy import Emcy
from canprobe.fieldbus.protocol.frames import EMCY_BASE

REPORTED = "by its encoders the arm stands at"


class Obeying:
    """A drive that makes `factor` of every way it is told to go, and tells the truth about it."""

    def __init__(self, node, factor):
        self._node, self._factor, self._start = node, factor, None

    def __getattr__(self, name):
        return getattr(self._node, name)

    def receive(self, can_id, data, t_ns):
        if can_id == 0x200 + self._node.node_id:
            word, target = struct.unpack("<Hi", data)
            self._start = target if self._start is None else self._start
            data = struct.pack("<Hi", word, round(self._start + self._factor * (target - self._start)))
        return self._node.receive(can_id, data, t_ns)


class Watcher:
    """An operator who sees the true arm: whether the joint in question turned by what it was told."""

    def __init__(self):
        self.session, self._before, self._question = None, None, ""

    def ask(self, question):
        self._question = question

    def answer(self):
        q = self.session.world.plant.truth()["q"]
        if self._question.startswith("joint"):
            self._before = q
            return Answer.YES
        joint = int(self._question.split()[2]) - 1
        told = float(self._question.split("about ")[1].split()[0])
        turned = np.degrees(q - self._before)
        return Answer.YES if abs(turned[joint] - told) < 0.1 else Answer.NO


@pytest.fixture
def cell(monkeypatch):
    """Lets the session of a check join its nodes through a function; `cell.session` is that session afterwards."""

    class Opened:
        session, joins, operator = None, staticmethod(lambda participant: participant), None

    def make(*args, **more):
        Opened.session = Session(*args, **more)
        participants = Opened.session.world.participants
        participants[:] = map(Opened.joins, participants)
        if Opened.operator is not None:
            Opened.operator.session = Opened.session
        return Opened.session

    monkeypatch.setattr(joint_report, "Session", make)
    return Opened


def on_node(node_id, change):
    return lambda one: change(one) if getattr(one, "node_id", None) == node_id else one


def flip(node):
    """Bit 7 of 607Eh: positions count the other way."""
    node.dictionary.values[key_of(0x607E)] = 0x80
    return node


def scene():
    free = canprobe.load_scene("free")
    return replace(free, cycle=replace(free.cycle, rate_hz=50.0), bus=replace(free.bus, timed=False))


def assert_disabled(session):
    words = [node.dictionary.number(0x6041) for node in session.world.nodes]
    assert not POWERED_STATES.intersection(map(state_of, words))


def test_a_sound_arm_is_found_so_and_its_pose_is_told(cell):
    cell.operator, said = Watcher(), []
    findings = canprobe.api.check_joints(scene(), operator=cell.operator, say=said.append)
    assert [(f.joint, f.fault, f.skipped) for f in findings] == [(joint, None, None) for joint in range(6)]
    assert [f.moved for f in findings] == pytest.approx([1.0] * 6, abs=0.03)
    assert said[-1].startswith(f"{REPORTED} 90.00, 65.00, 15.00, 0.00, 100.00, 0.")
    assert_disabled(cell.session)


def test_a_drive_that_obeys_the_wrong_way_round_is_named(cell):
    cell.joins, said = on_node(2, lambda node: Obeying(node, -1.0)), []
    with pytest.raises(NodeError, match=r"^node 2: \(joint 2\) it turned the wrong way$"):
        canprobe.api.check_joints(scene(), say=said.append)
    assert "joint 2 at 65.00 deg: asked +1.00 deg, turned -1.00 deg: it turned the wrong way" in said
    assert sum("as expected" in line for line in said) == 5
    assert_disabled(cell.session)


def test_a_flipped_polarity_that_no_encoder_shows_is_seen_by_the_operator(cell):
    """607Eh turns target and feedback round together: the arm moves the other way, and the numbers agree."""

    cell.joins, cell.operator, said = on_node(3, flip), Watcher(), []
    with pytest.raises(NodeError, match=r"^node 3: \(joint 3\) the operator did not see it turn that way: polarity"):
        canprobe.api.check_joints(scene(), operator=cell.operator, say=said.append)
    (line,) = [line for line in said if line.startswith("joint 3 ")]
    assert line.startswith("joint 3 at -15.00 deg: asked +1.00 deg, turned +1.00 deg: the operator did not see")
    assert f"{REPORTED} 90.00, 65.00, -15.00," in said[-1]  # and the pose is not the arm's
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
    assert said[-2].startswith("joint 1 at 90.00 deg: asked +1.00 deg, turned +1.0")
    assert_disabled(cell.session)


def test_a_scene_without_an_arm_is_refused():
    with pytest.raises(UsageError, match=r"scene listen has no \[arm\]"):
        canprobe.api.check_joints(canprobe.load_scene("listen"))


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("--check-joints",), "needs a terminal; --yes leaves that out"),
        (("--home",), "up --home asks before each motion and needs a terminal; --yes leaves that out"),
        (("--home", "--yes"), 'no joint of scene free has zero = "homing"'),
        (("--home", "--check-joints"), "--home and --check-joints are two steps"),
        (("--yes",), "--yes goes with --check-joints or --home"),
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
            session.lockstep.port().send_batch([(EMCY_BASE + 4, Emcy(0x8210, 0x11).pack())])
        return Command(done=measurement.cycle > 80)

    with reporting_notes(session, lines.append) as report_news:
        session.run(disturb, report_news)
        assert len(lines) == 1, "the second of the same kind is no news"
    what = "noted: node 4: EMCY 8210h, PDO not processed due to length error, "
    told = [re.findall(r"at ([\d.]+) s", line) for line in lines]
    first, last = (session.cell.start_ns * 1e-9 + cycle * 0.0025 for cycle in (60, 70))  # on the clock of bus.log
    assert [float(t) for times in told for t in times] == pytest.approx([first, first, last], abs=0.01)
    (one,), (start, end) = told
    assert lines == [what + f"at {one} s", what + f"2 times, first at {start} s, last at {end} s"]
