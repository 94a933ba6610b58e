"""A joint that does not follow, the way back that was taken, and what has to be asked for after a stop for safety."""

from __future__ import annotations

import math

import numpy as np
import pytest
from injected import SCAN_CYCLE, Injected

import canprobe
from canprobe.cell.master.trail import WAY_BACK
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.task import Phase
from canprobe.errors import NodeError, SafetyStop, UsageError


def steps_deg(run, joint):
    """Largest step of a joint in a cycle after the fault, degrees."""
    return math.degrees(np.abs(np.diff(run.session.buses.truth["q_rad"][run.at :, joint - 1])).max())


FAULTS = {
    "a brake that is stuck for a second": lambda run: run.inject("node 3: brake-stuck for 1 s"),
    "an encoder that is frozen": lambda run: run.inject("node 3: encoder-frozen"),
}


@pytest.mark.parametrize("what", FAULTS)
def test_a_joint_that_does_not_follow_is_left_out_and_the_probe_taken_off(what):
    run = Injected("plane", SCAN_CYCLE, FAULTS[what], until=2000)
    assert isinstance(run.error, NodeError) and run.error.node_id == 3
    assert "(joint 3) does not follow its targets" in str(run.error)
    assert run.session.cell.stopped_by.key == "following"
    assert run.session.buses.truth["force_n"][run.at] > 1.5
    assert run.session.buses.truth["force_n"].max() < 6.0 and run.session.buses.truth["force_n"][-1] == 0.0
    assert steps_deg(run, 3) < 0.03, "no leap when it lets go"
    assert any(fault.startswith("lift off, at ") for fault in run.session.cell.notes.lines())


def test_a_slow_joint_that_stands_for_a_moment_does_not_leap():
    """It is behind by less than what is looked for, and the scan goes on."""
    run = Injected("plane", SCAN_CYCLE + 160, lambda run: run.inject("node 3: brake-stuck for 50 ms"), until=160)
    assert run.session.buses.truth["force_n"].max() < 5.0 and steps_deg(run, 3) < 0.05


def test_a_joint_that_stands_in_the_approach_stops_the_cell_before_the_object():
    run = Injected("press", 50, FAULTS["a brake that is stuck for a second"], until=2000)
    assert run.task.phase in (Phase.MOVE, Phase.APPROACH)
    assert run.session.cell.stopped_by.key == "following"
    assert run.session.buses.truth["force_n"].max() == 0.0 and steps_deg(run, 3) < 0.1


def test_while_a_drive_is_not_heard_the_others_stand_where_they_were_and_go_on_smoothly():
    run = Injected("free", 200, lambda run: run.inject("node 3: mute for 11 ms"), until=300)
    assert run.error is None
    targets = run.session.cell.log.arrays()["q_target_rad"]
    first, held = run.at + np.flatnonzero(np.isnan(targets[run.at : run.at + 20]).all(axis=1))[0], [0, 1, 3, 4, 5]
    q = run.session.cell.log.arrays()["q_rad"]
    assert np.abs(targets[first + 1, held] - q[first + 1, held]).max() < 5e-4, (
        "next to where they are, not at the last target"
    )
    usual = np.nanmax(np.abs(np.diff(targets[: run.at], axis=0)))
    assert np.nanmax(np.abs(np.diff(targets[first + 2 :], axis=0))) < 3.0 * usual


@pytest.mark.parametrize(("phase", "t_s"), [(Phase.APPROACH, 0.05), (Phase.SETTLE, 0.1)])
def test_a_retreat_before_the_scan_goes_back_on_the_measured_way(phase, t_s):
    class Retreating(Injected):
        begun_ns = None

        def command(self, measurement, command):
            if self.task.phase is phase and self.begun_ns is None:
                self.begun_ns = measurement.t_ns
            if self.begun_ns is not None and measurement.t_ns == self.begun_ns + round(t_s * 1e9):
                self.came_to = measurement.cycle
                self.task.retreat("a test")
            return command

    run = Retreating("press", 5000, lambda _: None)
    assert isinstance(run.error, SafetyStop) and str(run.error) == "a test"
    log = run.session.cell.log.arrays()
    came, targets = log["q_rad"][: run.came_to + 1], log["q_target_rad"][run.came_to + 3 :]
    targets = targets[~np.isnan(targets[:, 0])]
    assert max(np.abs(came - q).max(axis=1).min() for q in targets) < 1e-3
    centre = run.session.buses.truth["probe_centre_m"]
    way, back = (float(np.linalg.norm(np.diff(c, axis=0), axis=1).sum()) for c in np.split(centre, [run.came_to]))
    assert back == pytest.approx(min(way, WAY_BACK), rel=0.15)
    assert run.session.buses.truth["force_n"][-1] == 0.0


def some_cycles(number=40):
    """A controller that holds for so many cycles."""
    left = iter(range(number))
    return lambda _: canprobe.Command(done=next(left, None) is None)


def stopped(session):
    def stop(measurement):
        return canprobe.Command(stop_reason="a test")

    with pytest.raises(SafetyStop):
        session.run(stop)


@pytest.mark.parametrize("recover", [False, True])
def test_after_a_stop_for_safety_nothing_moves_before_a_person_has_asked_for_it(recover):
    with canprobe.open_cell("free", recover=recover) as cell:
        stopped(cell)
        cycles = cell.cell.cycle.number
        for _ in range(2):
            with pytest.raises(UsageError, match=r"stopped for safety: a test; .* call resume\(\) before the next run"):
                cell.run(some_cycles())
        assert cell.cell.cycle.number == cycles
        cell.resume()
        cell.run(some_cycles())
        assert cell.cell.cycle.number > cycles
        stopped(cell)
        with pytest.raises(UsageError, match="stopped for safety"):
            cell.run(some_cycles())
    with pytest.raises(UsageError, match="the cell is closed"):
        cell.resume()


def test_a_stop_by_the_supervision_needs_the_word_too_and_a_mistake_in_a_call_does_not():
    session = Session(canprobe.load_scene("free"))
    faulty = session.buses.world.make_faulty()
    with session:
        with pytest.raises(UsageError):
            session.run(lambda measurement: None)
        faulty.inject("node 3: drive-fault at 100 ms", session.buses.lockstep.clock.now_ns())
        with pytest.raises(NodeError):
            session.run(some_cycles(2000))
        with pytest.raises(UsageError, match=r"stopped for safety: node 3: "):
            session.run(some_cycles())
