"""The way back of the probe: how far and how fast, which drives make it, and what ends it. Without a bus."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from puma_arm import ELBOW_FORM

import canprobe
from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.lift_off import LiftOff, WayBack
from canprobe.cell.master.supervision import limits_of
from canprobe.cell.master.trail import ARRIVAL_S, WAY_BACK, WAY_BACK_SPEED, TakenWay
from canprobe.cell.master.watch import NodeWatch
from canprobe.errors import NodeError, SafetyStop
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, NmtState
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.model import joints_to_units

PLAN = canprobe.plan("press")
MODEL, T_FLANGE_PROBE = PLAN.setup.arm.model, PLAN.setup.probe.T_flange_probe
PERIOD_S = PLAN.sync.period_ns * 1e-9
NODES = range(1, 7)


@pytest.mark.parametrize("still", [None, 0, 2, 5])
def test_the_way_is_straight_back_and_fast_at_first(still):
    free = np.arange(6) != (9 if still is None else still)
    way = WayBack(MODEL, T_FLANGE_PROBE, PERIOD_S, free)
    joints = [ELBOW_FORM]
    while (q := way.step(joints[-1], joints_to_units(MODEL, ELBOW_FORM))) is not None:
        joints.append(q)
    T = [forward(MODEL.chain, q) @ T_FLANGE_PROBE for q in joints]
    ways = np.array([one[:3, 3] - T[0][:3, 3] for one in T])
    back = -ways @ T[0][:3, 2]
    assert np.linalg.norm(ways + np.outer(back, T[0][:3, 2]), axis=1).max() < 0.01 * WAY_BACK
    assert back[-1] == pytest.approx(WAY_BACK, rel=0.01)
    assert len(joints) - 1 == pytest.approx((WAY_BACK / WAY_BACK_SPEED + ARRIVAL_S) / PERIOD_S, abs=1.5)
    speed = np.diff(back) / PERIOD_S
    assert speed[0] == pytest.approx(2 * WAY_BACK_SPEED, rel=0.02) and np.diff(speed).max() < 1e-4
    moving = round(WAY_BACK / WAY_BACK_SPEED / PERIOD_S)
    assert np.abs(speed[moving:]).max() < 1e-9 < speed[moving - 1]
    moved = np.abs(joints_to_units(MODEL, joints[-1]) - joints_to_units(MODEL, ELBOW_FORM)) > 1e-6
    assert moved.any() and not moved[~free].any()


def test_a_way_that_the_remaining_drives_cannot_make_ends():
    way = WayBack(MODEL, T_FLANGE_PROBE, PERIOD_S, np.arange(6) == 5)
    assert way.step(ELBOW_FORM, joints_to_units(MODEL, ELBOW_FORM)) is None


def test_a_way_begins_at_the_last_targets_and_a_motor_that_is_far_from_its_own_where_it_is():
    here, per_rad = joints_to_units(MODEL, ELBOW_FORM), np.diag(MODEL.units_per_q)
    ahead = per_rad * np.array([5e-3, 0, -9e-3, 0, 50e-3, 0])
    way = WayBack(MODEL, T_FLANGE_PROBE, PERIOD_S, np.ones(6, dtype=bool))
    begun = joints_to_units(MODEL, way.step(ELBOW_FORM, here + ahead))
    ahead[4] = 0.0
    assert (np.abs(begun - here - ahead) < 1e-3 * np.abs(per_rad)).all()


class Drives:
    """Six drives that are enabled and were heard in this cycle."""

    axes = tuple(SimpleNamespace(node_id=i) for i in NODES)
    disbelieved = False
    brakeable = (False,) * 6

    def __init__(self):
        self.age, self.on, self.beyond = [0] * 6, [True] * 6, {}
        aimed = joints_to_units(MODEL, ELBOW_FORM)
        self.targets = SimpleNamespace(stopped=frozenset(), aimed=aimed, beyond_lag=lambda: self.beyond)

    def ages(self):
        return tuple(self.age)

    def enabled_ones(self):
        return tuple(self.on)


def a_watch():
    watch = NodeWatch(PLAN.node_ids)
    for i in NODES:
        watch.push(HEARTBEAT_BASE + i, bytes((NmtState.OPERATIONAL,)), 0)
    return watch


def lift(drives, watch=None, error=None):
    return LiftOff(PLAN, drives, watch or a_watch(), error or SafetyStop("the sensor is lost"))


def test_a_drive_that_moves_otherwise_than_told_is_braked_by_its_place_and_not_by_its_quick_stop():
    """On its ramp it would go on without the others: 16 N in a fast stroke."""
    drives = Drives()
    drives.brakeable = tuple(i == 3 for i in NODES)
    way = lift(drives, error=NodeError(3, "does not follow its targets"))
    way.begin()
    assert drives.targets.stopped == set()
    assert not way._free[NODES.index(3)]


def test_without_a_drive_that_obeys_or_with_one_that_may_be_moving_nothing_lifts():
    drives = Drives()
    drives.on = [False] * 6
    assert not lift(drives).possible
    drives = Drives()
    drives.disbelieved = True
    assert not lift(drives).possible


class Cell:
    """What a lift-off asks of the supervisor."""

    def __init__(self):
        measurement = Measurement(1000, 0, q=ELBOW_FORM)
        self.seen = SimpleNamespace(measurement=measurement, limits=limits_of(PLAN), force=2.0, shows_a_part=False)
        self.stops, self.finding = False, None

    def must_stop(self):
        return self.stops

    def guard_target(self, command):
        return command, self.finding


def begun():
    drives, cell = Drives(), Cell()
    going = lift(drives)
    for _ in range(20):
        command = going.command(cell)
        cell.seen.measurement = replace(
            cell.seen.measurement, cycle=cell.seen.measurement.cycle + 1, q=command.q_target
        )
    return drives, cell, going


ENDS = {
    "two cycles without a TPDO": (lambda d, c: d.age.__setitem__(4, 2), False),
    "three cycles without a TPDO": (lambda d, c: d.age.__setitem__(4, 3), True),
    "a drive that is off": (lambda d, c: d.on.__setitem__(4, False), True),
    "a report that cannot be": (lambda d, c: setattr(d, "disbelieved", True), True),
    "a condition that forbids motion": (lambda d, c: setattr(c, "stops", True), True),
    "a joint at its stop": (lambda d, c: setattr(c, "finding", object()), True),
    "no positions": (lambda d, c: setattr(c.seen, "measurement", replace(c.seen.measurement, q=None)), True),
    "a force that does not grow": (lambda d, c: setattr(c.seen, "force", 2.25), False),
    "a force that grows": (lambda d, c: setattr(c.seen, "force", 2.3), True),
    "a joint that stands": (lambda d, c: d.beyond.update({4: 3.0}), True),
}


@pytest.mark.parametrize("what", ENDS)
def test_what_ends_a_lift_off_on_its_way(what):
    change, ends = ENDS[what]
    drives, cell, going = begun()
    change(drives, cell)
    assert (going.command(cell) is None) is ends


def test_a_drive_that_was_lost_before_does_not_end_it():
    drives, cell = Drives(), Cell()
    drives.age[2], drives.on[2] = 9, False
    going = lift(drives)
    drives.age[2] = 10
    assert going.command(cell) is not None


def test_a_drive_that_stood_before_does_not_end_it():
    drives, cell = Drives(), Cell()
    drives.beyond = {2: 3.0}
    assert lift(drives, error=NodeError(3, "does not follow")).command(cell) is not None
    assert lift(drives).command(cell) is None


def trail_of(joints):
    trail = TakenWay(MODEL, T_FLANGE_PROBE)
    for q in joints:
        trail.add(q, (0,) * 6)
    return trail


def come(steps=400):
    """Joints of a way that is not straight, 0.02 mm or so a step."""
    u = np.linspace(0.0, 1.0, steps)[:, None]
    return ELBOW_FORM + u * np.array([0.05, -0.03, 0.02, 0.01, -0.02, 0.03]) + 0.02 * np.sin(6.0 * u)


def test_where_the_way_is_known_it_goes_back_on_it_and_with_a_drive_at_rest_along_the_pole():
    joints = come()
    for still, follows in ((None, True), (2, False)):
        drives, cell = Drives(), Cell()
        if still is not None:
            drives.on[still] = False
        cell.seen.measurement = replace(cell.seen.measurement, q=joints[-1])
        going = LiftOff(PLAN, drives, a_watch(), SafetyStop("lost"), trail_of(joints))
        targets = []
        while (command := going.command(cell)) is not None:
            targets.append(command.q_target)
            cell.seen.measurement = replace(cell.seen.measurement, q=command.q_target)
        off = max(np.abs(joints - q).max(axis=1).min() for q in targets)
        assert len(targets) > 100 and bool(off < 5e-4) is follows, off


def test_the_command_is_the_guarded_one():
    drives, cell = Drives(), Cell()
    nearer = Command(ELBOW_FORM)
    cell.guard_target = lambda command: (nearer, None)
    assert lift(drives).command(cell) is nearer
