"""What the supervision remembers from cycle to cycle, and the joint guard at its borders. Without a bus."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
from puma_arm import ELBOW_FORM, UPENN

import canprobe
from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.drives import DriveAxis
from canprobe.cell.master.supervision import CycleState, Limits
from canprobe.cell.master.supervisor import JointGuard, PressDetector, Supervisor, outside_workspace
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.scene.setup import SafetyLimits
from canprobe.errors import SafetyStop
from canprobe.fieldbus.bus.port import ControllerState, PortCounters
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE

PERIOD_NS = 2_500_000
LIMITS = Limits(SafetyLimits(5.0, 0.15, 0.0, 1.0, 0.02, None), PERIOD_NS, tares=True)


def tip(back_mm, aside_mm=0.0):
    """The probe's tip so far back along its pole, z, and to the side."""
    T = np.eye(4)
    T[:3, 3] = 1e-3 * aside_mm, 0.0, -1e-3 * back_mm
    return T


@pytest.mark.parametrize(
    ("looks", "least"),
    [
        ([(2.0, tip(0)), (0.3, tip(3))], 0.15),
        ([(2.0, tip(0)), (0.3, tip(3.1))], 0.45),
        ([(2.0, tip(0)), (0.3, tip(-4))], 0.15),
        ([(2.0, tip(0)), (0.3, tip(4, 3.9))], 0.45),
        ([(2.0, tip(0)), (0.3, tip(4, 4.1))], 0.15),
        ([(2.0, tip(0)), (0.5, tip(1)), (0.3, tip(3.5))], 0.15),
        ([(2.0, tip(0)), (0.49, tip(1)), (0.3, tip(3.5))], 0.45),
        ([(4.0, tip(0)), (1.0, tip(1)), (0.9, tip(2)), (0.3, tip(4.5))], 0.45),
        ([(2.0, tip(0)), (0.3, tip(4)), (0.1, tip(9)), (0.2, tip(9))], 0.25),
        ([(2.0, tip(0)), (0.3, tip(4)), (0.5, tip(3)), (0.1, tip(5.9))], 0.15),
        ([(2.0, tip(0)), (0.3, tip(4)), (0.5, tip(3)), (0.1, tip(6.1))], 0.25),
    ],
)
def test_the_least_force_that_is_a_press(looks, least):
    """What the array remembers counts once the probe is 3 mm straight back from the last quarter of the press."""
    press = PressDetector()
    for force, T in looks:
        press.look(force, T)
    assert press.holds(least + 1e-9) and not press.holds(least - 1e-9)


class Run:
    """A supervisor of two nodes without an arm, cycle by cycle."""

    def __init__(self):
        self.seen = CycleState(LIMITS, NodeWatch((1, 2)), None, None, PortCounters())
        self.supervisor = Supervisor(self.seen, None)
        self.cycle = 0

    def step(self, *, late=0, state=ControllerState.ACTIVE, periods=1, **measured):
        self.cycle += 1
        self.seen.controller_state = state
        t_ns = self.seen.measurement.t_ns + periods * PERIOD_NS
        self.supervisor.step(Measurement(self.cycle, t_ns, **measured), 1000 + t_ns, self.seen.overruns + late)
        return self.seen


def test_the_gap_is_the_time_between_two_syncs():
    run = Run()
    assert [run.step(periods=n).gap_ns for n in (1, 1, 3)] == [0, PERIOD_NS, 3 * PERIOD_NS]


def test_the_time_for_which_the_controller_is_passive():
    run, active, passive = Run(), ControllerState.ACTIVE, ControllerState.PASSIVE
    passed = [run.step(state=state).passive_ns for state in (active, passive, passive, passive, active)]
    assert passed == [0, PERIOD_NS, 2 * PERIOD_NS, 3 * PERIOD_NS, 0]


def test_late_cycles_are_a_share_of_those_of_the_last_second():
    run = Run()
    for _ in range(500):
        run.step()
    assert run.step(late=1).late_share == pytest.approx(1 / 400)
    assert run.step(late=1).late_share == pytest.approx(2 / 400)
    shares = [run.step().late_share for _ in range(400)]
    assert shares[397:] == pytest.approx([2 / 400, 1 / 400, 0.0])
    assert run.step(late=1, periods=201).late_share == pytest.approx(1 / 200), "the others of that second are missing"


def test_the_preload_is_the_highest_force_before_the_drives_are_enabled():
    run, sample = Run(), SimpleNamespace(differs_from=lambda _: False)
    for force, enabled in ((0.1, False), (0.4, False), (0.2, True), (3.0, True), (2.0, False)):
        run.seen.patch = SimpleNamespace(force=force)
        run.step(tactile=sample, enabled=enabled)
    assert run.seen.preload == 0.4 and run.seen.force == 2.0


def test_something_worse_comes_before_a_hold_and_the_first_hold_before_the_second():
    run = Run()
    run.step(q_age=(0, 4), state=ControllerState.PASSIVE)
    axes, targets = [DriveAxis(1, (), ()), DriveAxis(2, (), ())], SimpleNamespace(beyond_lag=dict)
    run.seen.drives = SimpleNamespace(axes=axes, targets=targets)
    run.seen.measurement = Measurement(9, 0, q_age=(0, 4), enabled=True)
    found = run.supervisor.finding
    assert found().condition.key == "drive_late" and found(enabling=True).condition.key == "error_passive"
    assert run.supervisor.first == {"drive_late": 9, "error_passive": 9} and not run.supervisor.must_stop()
    run.seen.watch.push(HEARTBEAT_BASE + 1, b"\x04", 0)
    assert found().condition.key == "nmt_state" and not run.supervisor.must_stop()
    run.seen.controller_state = ControllerState.BUS_OFF
    assert found().condition.key == "nmt_state" and run.supervisor.must_stop()


# The joint guard.


@pytest.fixture(scope="module")
def plan():
    return canprobe.plan("free", {"limits.joint_speed_share": 0.5})


@pytest.fixture
def guard(plan):
    return JointGuard(plan)


def at(q, cycle, ages=(0,) * 6):
    return Measurement(cycle, cycle * PERIOD_NS, q=q, q_age=ages)


def limit_of(plan):
    return 0.5 * plan.setup.arm.model.qd_max * PERIOD_NS * 1e-9


def test_a_motion_is_measured_from_the_last_cycle_in_which_all_were_heard(plan, guard):
    step = 1.5 * limit_of(plan)
    assert guard.measure(at(ELBOW_FORM, 0)) is None
    assert guard.measure(at(ELBOW_FORM + 9 * step, 1, ages=(0, 1, 0, 0, 0, 0))) is None
    assert guard.measure(Measurement(2, 2 * PERIOD_NS)) is None
    assert guard.measure(at(ELBOW_FORM + 3.9 * step, 3)) is None, "three periods, and one for a late SYNC"
    told = guard.measure(at(ELBOW_FORM + 3.9 * step + np.array([0, 3.0, 0, 2.01, 0, 0]) * step, 4))
    assert told.startswith("joint 2 reports a motion of ")


def test_the_first_target_may_be_one_period_from_where_the_arm_is_and_the_next_one_from_the_first(plan, guard):
    step = limit_of(plan)
    np.testing.assert_allclose(guard.command(ELBOW_FORM + 4 * step, at(ELBOW_FORM, 0)), ELBOW_FORM + step)
    np.testing.assert_allclose(guard.command(ELBOW_FORM + 4 * step, at(ELBOW_FORM, 1)), ELBOW_FORM + 2 * step)
    given = ELBOW_FORM + 3 * step
    assert guard.command(given, at(ELBOW_FORM, 2)) is given and guard.slowed == 2
    assert guard.command(ELBOW_FORM + 9 * step, Measurement(3, 0))[0] == pytest.approx((ELBOW_FORM + 4 * step)[0])


def test_before_a_position_is_known_no_target_is_too_far(guard):
    assert guard.command(ELBOW_FORM, Measurement(0, 0)) is ELBOW_FORM and guard.slowed == 0


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (np.zeros(5), "has shape (5,): expected 6 finite angles, rad"),
        (np.zeros((6, 1)), "has shape (6, 1): expected 6 finite"),
        (np.array([0, np.nan, 0, 0, 0, 0]), "nan"),
        ([0, 0, np.inf, 0, 0, 0], "inf"),
        ("home", "is 'home': expected 6 angles, rad"),
        ([1j] * 6, "expected 6 angles"),
        *((one, "expected 6") for one in (np.ma.masked_all(6), np.zeros(6, dtype=bool), ["0"] * 6, [None] * 6, None)),
        ([[0.0], [0.0, 0.0]], "expected 6"),
    ],
)
def test_a_target_of_another_shape_or_without_numbers_is_named_and_never_sent(guard, given, told):
    with pytest.raises(SafetyStop, match=re.escape(told)):
        guard.command(given, at(ELBOW_FORM, 0))


@pytest.mark.parametrize("axis", range(6))
def test_a_target_may_come_as_near_to_a_stop_as_the_margin(plan, guard, axis):
    margin = np.radians(plan.scene.limits.joint_margin_deg)
    assert margin > 0
    for border, inward in ((UPENN.q_min, 1.0), (UPENN.q_max, -1.0)):
        q = (UPENN.q_min + UPENN.q_max) / 2
        q[axis] = border[axis] + inward * (margin + 1e-6)
        guard.command(q, at(q, 0))  # allowed
        q[axis] -= 2e-6 * inward
        with pytest.raises(SafetyStop, match=rf"^joint {axis + 1} at "):
            guard.command(q, at(q, 1))


@pytest.mark.parametrize("axis", range(6))
def test_a_measured_motion_of_three_halves_of_the_speed_in_two_periods_is_the_most(plan, axis):
    """A cycle's SYNC may come a period late, so two periods may have passed; two counts are the encoder's own."""
    for share, believed in ((0.999, True), (-0.999, True), (1.001, False), (-1.001, False)):
        guard = JointGuard(plan)
        most = 1.5 * limit_of(plan)[axis] * 2 + 2 * guard.count[axis]
        assert guard.measure(at(np.zeros(6), 0)) is None
        told = guard.measure(at(share * most * np.eye(6)[axis], 1))
        assert (told is None) is believed
        assert believed or told.startswith(f"joint {axis + 1} reports a motion of {np.degrees(most):.1f} deg")


def test_a_list_of_numbers_is_a_target_and_the_first_joint_beyond_is_named(guard):
    assert guard.command(ELBOW_FORM.tolist(), at(ELBOW_FORM, 0)) == ELBOW_FORM.tolist()
    beyond = ELBOW_FORM.copy()
    beyond[[2, 4]] = 99.0
    with pytest.raises(SafetyStop, match=r"^joint 3 at "):
        guard.command(beyond, at(ELBOW_FORM, 1))


@pytest.mark.parametrize(
    ("at_mm", "told"),
    [
        ((0, 0, 0), None),
        ((100, 200, 300), None),
        ((-0.1, 0, 400), "x = -0.1 mm, workspace ends at 0.0 mm"),
        ((50, 200.1, 100), "y = 200.1 mm, workspace ends at 200.0 mm"),
        ((50, 50, 300.1), "z = 300.1 mm, workspace ends at 300.0 mm"),
    ],
)
def test_the_workspace_ends_beyond_its_borders(at_mm, told):
    found = outside_workspace(1e-3 * np.array(at_mm), 1e-3 * np.array([[0, 0, 0], [100, 200, 300]]))
    assert found is None if told is None else told in found
