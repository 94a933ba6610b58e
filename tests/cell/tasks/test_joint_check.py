"""The first motion against motors that do something else: a controller and a few matrices, no bus."""

from __future__ import annotations

import math
import os
from dataclasses import replace

import numpy as np
import pytest
from puma_arm import UPENN

import canprobe
from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.tasks.joint_check import Answer, JointCheck, SeenWay, find_seen_fault
from canprobe.cli.operator import TerminalOperator
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.model import joints_to_units, units_to_joints

PERIOD_S = 0.02
START = np.radians((90.0, 65.0, 15.0, 0.0, 100.0, 0.0))


@pytest.fixture(scope="module")
def plan():
    return canprobe.plan("free", {"cycle.rate_hz": 1 / PERIOD_S})


@pytest.fixture(scope="module")
def guard(plan):
    return JointGuard(plan)


class Scripted:
    """An operator who says these words, each after some cycles."""

    def __init__(self, *words):
        self.questions, self._words, self._wait = [], list(words), 0

    def ask(self, question, *, for_way=False):
        self.questions.append(question)
        self._wait = 5

    def answer(self):
        self._wait -= 1
        if self._wait > 0:
            return None
        return self._words.pop(0) if self._words else Answer.YES


def run(check, motors=None, start=START):
    """Motors that make `motors` (6, 6) of what they are told; the targets (n, 6), rad, and the last command."""
    motors = np.eye(6) if motors is None else motors
    zero = joints_to_units(UPENN, start)
    q, targets = start, []
    for cycle in range(20_000):
        command = check.step(Measurement(cycle, round(cycle * PERIOD_S * 1e9), q))
        if command.done or command.stop_reason is not None:
            return np.array(targets), command
        if command.q_target is not None:
            targets.append(command.q_target)
            told = joints_to_units(UPENN, command.q_target) - zero
            q = units_to_joints(UPENN, np.round(zero + motors @ told))
    raise AssertionError("no end")


def test_each_joint_turns_alone_slowly_and_comes_back(plan):
    check = JointCheck(plan, None)
    targets, last = run(check)
    away = targets - START
    assert last.done and [f.joint for f in check.findings] == list(range(6))
    assert np.all((np.abs(away) > 1e-9).sum(axis=1) <= 1)
    assert np.degrees(away).min(axis=0) == pytest.approx([-1, 0, 0, 0, 0, 0]), "19.9 deg are left forwards"
    assert np.degrees(away).max(axis=0) == pytest.approx([0, 1, 1, 1, 1, 1])
    assert away[-1] == pytest.approx(np.zeros(6))
    speed = np.degrees(np.abs(np.diff(targets, axis=0)).max()) / PERIOD_S
    assert speed == pytest.approx(2.0, rel=0.01)
    for finding in check.findings:
        assert (
            finding.fault is None and finding.seen is None and finding.moved == pytest.approx(finding.asked, abs=0.02)
        )


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize(
    ("factor", "fault"),
    [(-1.0, "it turned the wrong way"), (0.0, "it did not turn"), (0.5, "it turned 0.50 times as far")],
)
def test_a_motor_that_does_something_else_is_named(plan, joint, factor, fault):
    motors = np.eye(6)
    motors[joint, joint] = factor
    check = JointCheck(plan, None)
    run(check, motors)
    findings = {f.joint: f.fault for f in check.findings}
    assert findings[joint].startswith(fault)
    for other, text in findings.items():
        if other != joint:  # joints 4 and 5 drag the motors behind them along, which shows there too
            assert text is None or f"the motor of joint {joint + 1} turned by" in text
    left_out = np.abs((1 - factor) * UPENN.units_per_q[joint]) * math.radians(1.0)
    dragged = {other for other in range(6) if other != joint and left_out[other] > 4}
    assert {other for other, text in findings.items() if text is not None and other != joint} == dragged


def test_a_motor_that_runs_along_is_told(plan):
    motors = np.eye(6)
    motors[2, 1] = 0.3
    check = JointCheck(plan, None)
    run(check, motors)
    assert check.findings[1].fault.startswith("the motor of joint 3 turned by")


def test_at_a_stop_a_joint_turns_the_other_way(plan, guard):
    start = START.copy()
    start[1] = guard.high[1] - math.radians(0.5)
    check = JointCheck(plan, None)
    targets, _ = run(check, start=start)
    assert check.findings[1].asked == pytest.approx(-1.0)
    assert np.all(targets <= guard.high + 1e-12) and np.all(targets >= guard.low - 1e-12)


def test_beyond_a_stop_nothing_moves(plan, guard):
    start = START.copy()
    start[4] = guard.low[4] - math.radians(2.0)
    check = JointCheck(plan, None)
    assert check.inspect(START) is None
    assert check.inspect(
        start
    ) == "joint 5 stands at -31.0 deg, outside -29.0 to 199.0 deg: check counts_per_turn and" + (
        " gear, then sign and zero_counts; if they are right, move it there by hand"
    )


def test_a_workspace_without_room_is_left_alone(plan, guard):
    tip = guard.T_base_tip(START)[:3, 3]
    limits = replace(plan.setup.limits, workspace=np.array([tip - 1e-5, tip + 1e-5]))
    check = JointCheck(replace(plan, setup=replace(plan.setup, limits=limits)), None)
    targets, last = run(check)
    assert last.done
    skipped = [finding.skipped for finding in check.findings]
    assert skipped[:5] == ["either way it would leave its limits or the workspace"] * 5
    assert skipped[5] is None  # joint 6 turns the probe about its own axis
    assert np.ptp(targets[:, :5]) == pytest.approx(np.ptp(START[:5]))


def test_nothing_moves_before_the_operator_says_so(plan):
    yes, no = Answer.YES, Answer.NO
    operator = Scripted(no, yes, yes, yes, SeenWay(11.0), yes, no, yes, yes, no, Answer.QUIT)
    check = JointCheck(plan, operator)
    targets, last = run(check)
    assert last.done
    assert [(f.joint, f.skipped, f.fault) for f in check.findings] == [
        (0, "as the operator wished", None),
        (1, None, None),
        (2, None, "the operator did not see it turn that way: polarity, gear or another joint's drive"),
        (3, None, None),
    ]
    assert [(f.seen, f.unseen) for f in check.findings[1::2]] == [
        ("+11 deg", None),
        (None, "no larger way was seen, as the operator wished"),
    ]
    assert operator.questions[:5] == [
        "joint 1 at 90.00 deg: turn it by -1.00 deg?",
        "joint 2 at 65.00 deg: turn it by +1.00 deg?",
        "did joint 2 turn by about +1.0 deg, positive by the right hand round its axis?",
        "joint 2 at 65.00 deg: turn it by +10.00 deg?",
        "by how many degrees did joint 2 turn (Enter for +10.0), or how far did its flange go, straight, such as"
        " 35 mm?",
    ]
    assert targets[-1] == pytest.approx(START) and np.all(targets[:, 4:] == START[4:])
    assert np.degrees(targets - START).max(axis=0) == pytest.approx([0, 10, 1, 1, 0, 0])


def test_an_operator_who_ends_while_a_joint_is_away_gets_it_back_first(plan):
    for answers in ([Answer.YES], [Answer.YES] * 2, [Answer.YES] * 3):
        check = JointCheck(plan, Scripted(*answers, Answer.QUIT))
        targets, last = run(check)
        assert last.done and targets[-1] == pytest.approx(START)
        assert [(f.joint, f.fault, f.seen) for f in check.findings] == [(0, None, None)]


def test_the_terminal_is_never_waited_for(capsys):
    reader, writer = os.pipe()
    operator = TerminalOperator(reader)

    def ask(*typed, for_way=False):
        operator.ask("move?", for_way=for_way)
        answers = [operator.answer()]
        for text in typed:
            os.write(writer, text)
            answers += [operator.answer() for _ in range(20)]
        return [answer for answer in answers if answer is not None]

    os.write(writer, b"typed too early\n")
    assert ask() == []
    assert ask(b"\n") == [Answer.YES]
    assert ask(b"n", b"o\n") == [Answer.NO]
    assert ask(b"perhaps\n", b" Y \n") == [Answer.YES]
    assert ask(b"q\n") == [Answer.QUIT]
    assert ask(b"9.5\n", b"\n") == [Answer.YES], "no number was asked for"
    numbers = {
        b"9.5": (9.5, None, False),
        b"-10 deg": (-10, "deg", True),
        "+8,5°".encode(): (8.5, "deg", True),
        b"35mm": (35, "mm", False),
    }
    for typed, way in numbers.items():
        assert ask(typed + b"\n", for_way=True) == [SeenWay(*way)], typed
    assert ask(b"10 cm\n", b"n\n", for_way=True) == [Answer.NO]
    assert ask(b"\n", for_way=True) == [Answer.YES]
    operator.ask("move?")
    os.write(writer, b"y")  # a pipe may end without a new line
    os.close(writer)
    ended = [answer for _ in range(100) if (answer := operator.answer()) is not None]
    assert ended[:2] == [Answer.YES, Answer.QUIT]
    os.close(reader)
    assert "move? [Enter or y: yes, n: no, q: end]" in capsys.readouterr().err


@pytest.mark.parametrize("factor", [0.5, 0.7, 1.3, 2.0, -1.0, 0.01])
@pytest.mark.parametrize("due", [10.0, -10.0, 35.0])
def test_a_way_that_is_half_or_twice_is_told_from_one_that_an_eye_misjudges(factor, due):
    for eye in (0.9, 1.0, 1.1):
        assert find_seen_fault(eye * due, due, "deg") is None
        fault = find_seen_fault((0.95 if factor > 1 else 1.05) ** 0.5 * factor * due, due, "deg")
        assert ("the wrong way" if factor < 0 else "times as far") in fault


def test_a_way_of_the_flange_is_as_good_as_an_angle(plan):
    """Of joint 2 by 10 deg: the chord of a circle. Joint 6 turns the flange on the spot, so millimetres say nothing."""
    q = START.copy()
    q[1] += math.radians(10.0)
    chord = 1e3 * float(np.linalg.norm((forward(UPENN.chain, q) - forward(UPENN.chain, START))[:3, 3]))
    for said, right in ((chord, True), (0.5 * chord, False), (2.0 * chord, False)):
        check = JointCheck(plan, Scripted(Answer.NO, *[Answer.YES] * 3, SeenWay(round(said), "mm"), Answer.QUIT))
        run(check)
        finding = check.findings[1]
        assert finding.seen == f"{round(said)} mm of the flange, where {chord:.0f} mm are due"
        assert (finding.fault is None) == right
    operator = Scripted(*[Answer.NO] * 5, *[Answer.YES] * 3, SeenWay(35, "mm"), SeenWay(-9, "deg"))
    check = JointCheck(plan, operator)
    run(check)
    assert check.findings[5].fault == "it turned the wrong way, as the operator saw it: sign, or polarity (607Eh)"
    assert operator.questions[-1] == operator.questions[-2] and "flange" not in operator.questions[-1]


@pytest.mark.parametrize(("answer", "told"), [(SeenWay(6), None), (SeenWay(3), "fault"), (SeenWay(21, "mm"), "seen")])
def test_below_ten_degrees_only_a_measured_way_tells_gears_apart(plan, guard, answer, told):
    """The workspace leaves joint 2 six degrees either way."""
    start, low, high = START.copy(), guard.low.copy(), guard.high.copy()
    check = JointCheck(plan, Scripted(Answer.NO, *[Answer.YES] * 3, answer, Answer.QUIT))
    low[1], high[1] = start[1] - math.radians(4.5), start[1] + math.radians(6.5)
    check._guard.low, check._guard.high = low, high
    targets, _ = run(check, start=start)
    finding = check.findings[1]
    assert finding.asked == pytest.approx(6.0) and np.all(targets <= high) and np.all(targets >= low)
    assert (finding.fault is not None) == (told == "fault")
    assert (finding.seen is not None) == (told is not None)
    assert (finding.unseen is not None) == (told is None)
    if told is None:
        assert str(finding).endswith(
            ": as expected; gear and counts are not known, there is room for 6.0 deg only: turn it away from its stop,"
            " or measure"
        )


def test_with_room_for_the_small_way_alone_the_way_is_asked_for_all_the_same(plan, guard):
    check = JointCheck(plan, Scripted(*[Answer.YES] * 3, SeenWay(-1.0), Answer.QUIT))
    check._guard.low, check._guard.high = guard.low.copy(), guard.high.copy()
    check._guard.high[0] = START[0] + math.radians(0.3)
    check._guard.low[0] = START[0] - math.radians(1.7)
    run(check)
    (finding,) = check.findings
    assert finding.asked == pytest.approx(-1.0) and finding.unseen.startswith("there is room for 1.0 deg only")


@pytest.mark.parametrize(("signed", "right"), [(False, True), (True, False)])
def test_a_number_without_a_sign_goes_the_way_that_was_asked_for(plan, signed, right):
    check = JointCheck(plan, Scripted(*[Answer.YES] * 3, SeenWay(9.0, None, signed), Answer.QUIT))
    run(check)
    (finding,) = check.findings
    assert finding.asked == pytest.approx(-10.0) and (finding.fault is None) == right
