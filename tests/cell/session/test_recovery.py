"""When a cell comes back and when it does not: which losses may pass, how often it tries, and what is stopped."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

import canprobe
from canprobe.cell.master.conditions import BY_KEY
from canprobe.cell.master.controller import Command, Controller
from canprobe.cell.master.homing import UnhomedError
from canprobe.cell.session import recovery
from canprobe.cell.session.recovery import BRING_UP_ATTEMPTS, STEADY_NS, Recovery, may_pass
from canprobe.errors import InterfaceError, NodeError, SafetyStop
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus

LOST, STOP, DOWN = NodeError(3, "lost"), SafetyStop("stop"), InterfaceError("can0: down")
PERIOD_NS = 2_500_000


class Nodes:
    """What a recovery asks of a cell: it was lost by a condition, and some nodes are silent, booted or alarmed."""

    def __init__(self, key=None, *, silent=None, booted=(), alarmed=(), gap_ns=0):
        limits = SimpleNamespace(missed_cycles=5, period_ns=PERIOD_NS)
        measurement = SimpleNamespace(t_ns=0)
        seen = SimpleNamespace(sync_ns=0, gap_ns=gap_ns, limits=limits, measurement=measurement)
        self.stopped_by = None if key is None else BY_KEY[key]
        self.watch = SimpleNamespace(
            silent=lambda _: silent, last_alarm=dict.fromkeys(alarmed, "EMCY"), alarmed=set(alarmed), foreign=None
        )
        self.bring_up = SimpleNamespace(booted_again=lambda: set(booted), released=set())
        self.supervisor = SimpleNamespace(seen=seen)
        self.drives, self.cycles = None, SimpleNamespace(run_s=lambda _: 0.0)
        self.notes = SimpleNamespace(add=lambda *_, **__: None, add_error=lambda *_: None)


@pytest.mark.parametrize(
    ("error", "cell", "passes"),
    [
        (DOWN, Nodes("joint_speed"), True),
        (LOST, Nodes("heartbeat"), True),
        (STOP, Nodes("foreign_master"), True),
        (STOP, Nodes("joint_speed"), False),
        (LOST, Nodes("log"), False),
        (LOST, Nodes(silent=3), True),
        (LOST, Nodes(booted=[3]), True),
        (LOST, Nodes(), False),
        (STOP, Nodes(silent=3), False),
        (LOST, Nodes("drive_fault", alarmed=[3]), True),
        (LOST, Nodes("drive_fault", alarmed=[4]), False),
        (LOST, Nodes("drive_fault", gap_ns=5 * PERIOD_NS), False),
        (LOST, Nodes("drive_fault", gap_ns=5 * PERIOD_NS + 1), True),
    ],
)
def test_a_loss_that_may_pass(error, cell, passes):
    """A drive that left its state without a word on the bus lost its power by somebody's hand, or has a fault."""
    assert bool(may_pass(error, cell)) is passes


class Going(Controller):
    resumable = True

    def step(self, measurement):
        return Command()


class Cell(Nodes):
    """A cell that is lost after some time, or cannot be brought up; `told` is what was done with it."""

    def __init__(self, bench, *, fails=None, lasts_ns=None):
        super().__init__("heartbeat")
        self.bench, self.fails, self.lasts_ns, self.told = bench, fails, lasts_ns, []

    def __enter__(self):
        self.told.append("enter")
        if self.fails is not None:
            raise self.fails

    def start(self, task):
        self.told.append("start")

    def advance(self, cycles, progress):
        if self.lasts_ns is not None:
            self.bench.now += self.lasts_ns
            raise LOST

    def stop(self):
        self.told.append("stop")

    def close(self):
        self.told.append("close")


class Bench:
    """A recovery whose nodes are always there, on a clock that cells move on."""

    def __init__(self, monkeypatch, cells):
        monkeypatch.setattr(recovery, "_Wait", lambda *_: self)
        self.now, self.said, self.opened = 0, [], 0
        self.clock, self.cells = self, [Cell(self, lasts_ns=STEADY_NS), *(Cell(self, **one) for one in cells)]
        left = iter(self.cells[1:])
        self.recovery = Recovery(
            canprobe.plan("free"),
            self.cells[0],
            self,
            make_cell=lambda *_: next(left),
            buses=self,
            say=self.said.append,
            longest_s=60.0,
        )

    def now_ns(self):
        return self.now

    def close(self):
        self.opened -= 1

    def raise_ended(self):
        pass

    def reopen(self, port):
        self.opened += 1
        return self

    def look(self, port, must_boot):
        return None

    def without_power(self, port, released):
        return {2}

    def run(self):
        self.recovery.run(Going(), lambda _: None)

    def told(self):
        return [cell.told for cell in self.cells]


UP, FAILED = ["enter", "start"], ["enter", "stop"]


def test_a_cell_that_fails_to_come_up_is_stopped_and_another_one_tried(monkeypatch):
    bench = Bench(monkeypatch, [{"fails": LOST}, {"fails": LOST}, {"fails": DOWN}, {}])
    bench.run()
    assert bench.told() == [["start", "stop"], FAILED, FAILED, FAILED, UP]
    assert bench.recovery.cell is bench.cells[-1] and bench.opened == 1
    assert [line for line in bench.said if line.startswith("not back")] == [
        f"not back yet: {e}" for e in (LOST, LOST, DOWN)
    ]
    assert all(cell.doubted == {2} for cell in bench.cells[1:])


@pytest.mark.parametrize("error", [UnhomedError(3, "is not homed"), STOP])
def test_what_a_person_must_look_at_is_not_tried_again(monkeypatch, error):
    bench = Bench(monkeypatch, [{"fails": error}, {}])
    with pytest.raises(type(error)):
        bench.run()
    assert bench.told()[1:] == [FAILED, []]


def test_after_so_many_failures_it_ends_and_a_new_request_begins_anew(monkeypatch):
    bench = Bench(monkeypatch, [*[{"fails": LOST}] * BRING_UP_ATTEMPTS, {}])
    with pytest.raises(NodeError):
        bench.run()
    assert bench.told()[1:] == [FAILED] * BRING_UP_ATTEMPTS + [[]]
    bench.recovery.resume()
    assert bench.told()[-1] == ["enter"] and bench.said[-1].startswith("the cell is back after 0.0 s")


def test_the_last_cell_is_stopped_and_then_the_bus_closed(monkeypatch):
    bench = Bench(monkeypatch, [{}])
    bench.run()
    bench.recovery.close()
    assert bench.told() == [["start", "stop"], [*UP, "close"]] and bench.opened == -1


@pytest.mark.parametrize(
    ("lasts_ns", "returns"), [(STEADY_NS, BRING_UP_ATTEMPTS), (STEADY_NS + 1, BRING_UP_ATTEMPTS + 3)]
)
def test_a_loss_within_a_second_of_the_return_is_a_failure_to_return(monkeypatch, lasts_ns, returns):
    bench = Bench(monkeypatch, [{"lasts_ns": lasts_ns}] * (BRING_UP_ATTEMPTS + 2) + [{}])
    if returns == BRING_UP_ATTEMPTS:
        with pytest.raises(NodeError):
            bench.run()
    else:
        bench.run()
    assert bench.told().count([*UP, "stop"]) + bench.told().count(UP) == returns


def test_motion_that_is_asked_for_while_nothing_is_lost_brings_nothing_up(monkeypatch):
    bench = Bench(monkeypatch, [{}])
    bench.recovery.resume()
    assert bench.told() == [[], []] and not bench.said


def test_motion_that_is_asked_for_during_a_recovery_brings_nothing_up_a_second_time(monkeypatch):
    """From another thread, while the cell is lost and waits for its nodes."""
    bench, looks = Bench(monkeypatch, [{}, {}]), []

    def look(port, must_boot):
        looks.append(must_boot)
        if len(looks) == 1:
            bench.recovery.resume()

    monkeypatch.setattr(bench, "look", look, raising=False)
    bench.run()
    assert bench.told()[1:] == [UP, []] and len(looks) == 1


def test_a_drive_that_does_not_answer_is_asked_as_long_and_as_often_as_the_cell_says():
    """Whether it kept its power is not known then: it counts as one that did not."""
    scene = canprobe.load_scene("free")
    name = list(scene.joints)[2]
    joint = replace(scene.joints[name], zero="homing", homing_method=37, home_deg=0.0)
    scene = replace(scene, joints={**scene.joints, name: joint})
    plan = canprobe.plan(replace(scene, bring_up=replace(scene.bring_up, sdo_s=0.04, retries=3)))
    clock = VirtualClock()
    port = LockstepBus(clock, plan.buses[0].channel).port()
    assert recovery._Wait(plan, foreign=False).without_power(port, set()) == {3}
    assert clock.now_ns() * 1e-9 == pytest.approx(4 * 0.04, rel=0.1)
