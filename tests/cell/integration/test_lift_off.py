"""A node is lost while the probe presses: the drives that obey take it off, unless one may be moving by itself."""

from __future__ import annotations

import signal
from dataclasses import replace
from itertools import count
from struct import pack, unpack

import numpy as np
import pytest
from injected import HOLD_CYCLE, Injected, altered, send

import canprobe
from canprobe.cell.master.controller import Command
from canprobe.cell.master.supervision import CycleState
from canprobe.cell.master.trail import WAY_BACK
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.task import Phase
from canprobe.errors import SafetyStop
from canprobe.fieldbus.bus.port import ControllerState
from canprobe.fieldbus.bus.real.interrupts import Terminated
from canprobe.fieldbus.protocol.cia402 import DriveState, state_of
from canprobe.fieldbus.protocol.emcy import Emcy
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, SYNC_ID, NmtCommand, NmtState, pack_nmt
from canprobe.mechanics.touch.stops import TOUCH_FORCE


def lifted(run):
    """How far the probe's centre went back along its pole after the fault, m, and how far to the side."""
    truth = run.session.buses.truth
    way = truth["probe_centre_m"][-1] - truth["probe_centre_m"][run.at]
    back = -float(way @ truth["pole"][run.at])
    return back, float(np.linalg.norm(way + back * truth["pole"][run.at]))


def turned(run):
    """How far each motor turned after the fault, counts."""
    return np.ptp(run.session.buses.truth["q_rad"][run.at :] @ run.session.cell.drives.model.units_per_q.T, axis=0)


def mute(node_id):
    return "drive_silent", lambda r: r.inject(f"node {node_id}: mute")


LOST = {
    "joint 1 is mute": mute(1),
    "joint 3 boots again": ("nmt_state", lambda r: r.inject("node 3: reboot for 1 ms")),
    "joint 5 has a fault": ("drive_fault", lambda r: r.inject("node 5: drive-fault")),
    "joint 6 is frozen": ("drive_silent", lambda r: r.inject("node 6: freeze")),
    "joint 3 has no heartbeat": ("heartbeat", lambda r: r.inject("node 3: heartbeat-off")),
    "the sensor is stopped": ("nmt_state", lambda r: r.inject("node 16: nmt command=2")),
}


@pytest.mark.parametrize("what", LOST)
def test_the_probe_is_taken_off(what):
    key, action = LOST[what]
    run = Injected("press", HOLD_CYCLE, action)
    run.assert_within(key).assert_drives_off(but=(6,) if "frozen" in what else ())
    assert run.session.buses.truth["force_n"][run.at] == pytest.approx(2.0, abs=0.2)
    assert run.session.buses.truth["force_n"][-1] == 0.0
    back, aside = lifted(run)
    assert 0.95 * WAY_BACK < back < 1.2 * WAY_BACK and aside < 0.05 * WAY_BACK, (
        "without a sensor the task begins to retreat by itself"
    )
    assert any(fault.startswith("lift off, at ") for fault in run.session.cell.notes.lines())
    if what.startswith("joint"):
        lost = int(what.split()[1]) - 1
        assert turned(run)[lost] < 30, "it stood still"
        assert turned(run).max() > 100, "others did not"


def test_two_lost_drives_leave_four():
    def both(run):
        run.inject("node 2: mute")
        run.inject("node 6: mute")

    run = Injected("press", HOLD_CYCLE, both)
    run.assert_within("drive_silent").assert_drives_off()
    assert run.session.buses.truth["force_n"][-1] == 0.0


def pressed_on(run, told):
    run.assert_drives_off()
    assert run.session.buses.truth["force_n"][-1] == pytest.approx(2.0, abs=0.3)
    assert abs(lifted(run)[0]) < 0.1 * WAY_BACK
    assert any(told in fault for fault in (str(run.error), *run.session.cell.notes.lines()))


def test_a_drive_that_tells_what_cannot_be_may_be_moving():
    change = lambda d: d[:2] + pack("<i", unpack("<i", d[2:6])[0] + 2000) + d[6:]  # noqa: E731
    run = Injected("press", HOLD_CYCLE, lambda r: altered(r.nodes[2], 0x182, change))
    pressed_on(run, "no lift-off: a drive may be moving")


def test_with_another_master_nothing_moves():
    run = Injected("press", HOLD_CYCLE, lambda r: send(r, (SYNC_ID, b"")))
    pressed_on(run, "another master")
    (force,) = left_pressing(run.session)
    assert 1.8 < force < 2.2
    assert any(
        fault.endswith("free it; a run does not begin while the array measures a force")
        for fault in run.session.cell.notes.lines()
    )


def test_with_a_node_that_another_master_took_nothing_moves():
    """The node has left operation, for which the others would lift."""
    run = Injected("press", HOLD_CYCLE, lambda r: send(r, pack_nmt(NmtCommand.STOP, 16)))
    pressed_on(run, "another master is on the bus: an NMT command")
    assert not any("lift off" in fault for fault in run.session.cell.notes.lines())


@pytest.mark.parametrize("other", ["bus-off", "a jump"])
def test_nothing_lifts_where_another_condition_says_stop(other):
    """A drive is lost in the same cycle: the reaction to that alone would be to lift."""

    def both(run):
        run.inject("node 3: reboot for 1 ms")
        if other == "bus-off":
            run.session.cell.port.state = ControllerState.BUS_OFF
        else:
            run.session.cell.supervisor._guard.measure = lambda _: "joint 2 reports a motion"

    run = Injected("press", HOLD_CYCLE, both)
    pressed_on(run, "node 3: left operation")
    assert not any("lift off" in fault for fault in run.session.cell.notes.lines())


def interrupted(number):
    return lambda run: signal.raise_signal(number)


def failing(_):
    raise ZeroDivisionError


class Twice(Injected):
    """Ctrl-C in contact, and something else 10 cycles into the lift-off, which takes 64."""

    def __init__(self, second):
        self.second, self.lifting = second, 0
        super().__init__("press", HOLD_CYCLE, interrupted(signal.SIGINT))

    def _say(self, text):
        super()._say(text)
        if text.startswith("lift off"):
            inner = self.session.cell.log.add

            def add(row):
                inner(row)
                self.lifting += "q_target_rad" in row
                if self.lifting == 10 and "q_target_rad" in row:
                    self.second(self)

            self.session.cell.log.add = add


def master_heard(run):
    send(run, (SYNC_ID, b""))


def bus_off(run):
    run.session.cell.port.state = ControllerState.BUS_OFF


def drive_fault(run):
    run.inject("node 4: drive-fault")


def disabled(node_id):
    """A drive that is switched off without a word, as by its enable input."""
    return lambda run: altered(run.nodes[node_id], 0x180 + node_id, lambda d: b"\x50\x06" + d[2:])


def moving(run):
    """A drive reports what it cannot have reached."""
    altered(run.nodes[2], 0x182, lambda d: d[:2] + pack("<i", unpack("<i", d[2:6])[0] + 2000) + d[6:])


@pytest.mark.parametrize(
    ("second", "cycles"),
    [(master_heard, 1), (bus_off, 0), (drive_fault, 2), (disabled(4), 1), (moving, 1), (mute(5)[1], 3)],
)
def test_a_lift_off_does_not_go_on_when_something_else_comes(second, cycles):
    run = Twice(second)
    assert type(run.error) is KeyboardInterrupt
    assert 10 <= run.lifting <= 10 + cycles
    assert 0.2 * WAY_BACK < lifted(run)[0] < 0.5 * WAY_BACK, "as far as it was, and what is left of the motion"
    if second is master_heard:
        assert "another master is on the bus: SYNC from another master" in run.session.cell.notes.lines()


def test_a_disabled_drive_stands_still_and_the_others_lift():
    """The sensor is what the cell is stopped for; the drive is found by its power state alone."""

    def both(run):
        run.inject("node 16: reboot for 1 ms")
        disabled(2)(run)

    run = Injected("press", HOLD_CYCLE, both)
    assert "node 16: left operation" in str(run.error)
    assert run.session.buses.truth["force_n"][-1] == 0.0
    assert turned(run)[1] < 30 and turned(run).max() > 100


def test_a_drive_with_an_alarm_stands_still_also_where_another_one_had_one_before():
    def alarms(run):
        run.inject("node 1: drive-fault")
        send(run, (EMCY_BASE + 1, Emcy(0x4310, 0x09).pack()))
        send(run, (EMCY_BASE + 2, Emcy(0x4210, 0x09).pack()))

    run = Injected("press", HOLD_CYCLE, alarms)
    assert run.error.node_id == 1
    assert run.session.buses.truth["force_n"][-1] == 0.0
    assert turned(run)[1] < 30 and turned(run).max() > 100
    words = run.session.cell.log.arrays()["statusword"][run.at + 60].astype(int).tolist()
    assert [state_of(word) is DriveState.OPERATION_ENABLED for word in words] == [False, False, True, True, True, True]


def test_a_drive_that_left_operation_beside_the_one_that_is_named_does_not_lift():
    """Both are still enabled by their statuswords, and follow targets."""

    def left(run):
        for node_id in (3, 5):
            send(run, (HEARTBEAT_BASE + node_id, bytes((NmtState.PRE_OPERATIONAL,))))

    run = Injected("press", HOLD_CYCLE, left)
    assert "node 3: left operation" in str(run.error)
    assert run.session.buses.truth["force_n"][-1] == 0.0
    assert max(turned(run)[2], turned(run)[4]) < 30 and turned(run).max() > 100


def left_pressing(session):
    """The forces that the user is told to free, N."""
    return [float(fault.split(" N")[0].split()[-1]) for fault in session.cell.notes.lines() if "left pressing" in fault]


def test_a_light_press_after_a_strong_one_is_told():
    class Softer(Injected):
        def command(self, measurement, command):
            share = np.clip((self.at - measurement.cycle) / 200.0, 0.0, 1.0)
            if share < 1.0:
                self.task.targets["target_force_n"] = 0.4 + 1.6 * float(share)
            return command

    run = Softer("press", HOLD_CYCLE + 200, lambda r: send(r, (SYNC_ID, b"")))
    assert run.session.buses.truth["force_n"].max() > 1.8 and 0.15 < run.session.buses.truth["force_n"][-1] < 0.5
    assert left_pressing(run.session) == [pytest.approx(run.session.buses.truth["force_n"][-1], abs=0.15)]


@pytest.mark.slow(reason="12 s of a press")
def test_what_the_array_remembers_is_no_press_and_what_comes_on_top_of_it_is():
    """After 6 s at 7 N the array shows for a while what a touch would, although creep is corrected."""
    scene = canprobe.load_scene("press", {"task.duration_s": 6.0})
    scene = replace(scene, task=replace(scene.task, force_n=7.0, clearance_mm=0.8))
    scene = replace(scene, limits=replace(scene.limits, force_max_n=12.0))
    remembered = []
    for pressed_again in (False, True):
        with Session(scene) as session:
            session.run(make_task(session.plan))
            remembered.append(session.cell.supervisor.seen.force)
            if pressed_again:
                task = make_task(session.plan)
                session.run(lambda m, step=task.step: replace(step(m), done=task.phase is Phase.SCAN))  # noqa: B023
        told = left_pressing(session)
        # the drives stop a count or two from where the last image was taken: 0.6 N a count of joint 3 at this force
        assert told == ([pytest.approx(session.buses.truth["force_n"][-1], abs=0.6)] if pressed_again else [])
        assert bool(session.buses.truth["force_n"][-1] > 4.0) is pressed_again
    assert min(remembered) > TOUCH_FORCE, "by its size it could be a press"


def test_after_bus_off_nothing_can_be_sent():
    def off(run):
        run.session.cell.port.state = ControllerState.BUS_OFF

    pressed_on(Injected("press", HOLD_CYCLE, off), "left pressing")


LEFT = {
    "Ctrl-C": (interrupted(signal.SIGINT), KeyboardInterrupt),
    "the terminal is closed": (interrupted(signal.SIGHUP), Terminated),
    "the controller fails": (failing, ZeroDivisionError),
}


@pytest.mark.usefixtures("hangup_heard")
@pytest.mark.parametrize("what", LEFT)
def test_whoever_ends_the_run_the_probe_is_taken_off(what):
    action, kind = LEFT[what]
    run = Injected("press", HOLD_CYCLE, action)
    run.assert_within("interrupt").assert_drives_off()
    assert type(run.error) is kind
    assert any(fault.startswith("lift off, at ") for fault in run.session.cell.notes.lines())
    assert not any("left pressing" in fault for fault in run.session.cell.notes.lines())
    assert run.session.buses.truth["force_n"][run.at] == pytest.approx(2.0, abs=0.2)
    assert run.session.buses.truth["force_n"][-1] == 0.0
    back, aside = lifted(run)
    assert 0.95 * WAY_BACK < back < 1.05 * WAY_BACK and aside < 0.05 * WAY_BACK
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_controller_that_returns_no_command_is_told_so_off_the_object():
    class Forgetful(Injected):
        def command(self, measurement, command):
            return command if measurement.cycle < self.at else None

    run = Forgetful("press", HOLD_CYCLE, lambda _: None)
    run.assert_within("interrupt").assert_drives_off()
    assert str(run.error) == "controller: expected its step to return a Command, got None"
    assert run.session.buses.truth["force_n"][run.at] == pytest.approx(2.0, abs=0.2)
    assert run.session.buses.truth["force_n"][-1] == 0.0


def test_nobody_need_listen():
    """`canprobe up SCENE 2>&1 | tee FILE`: Ctrl-C ends tee first, and each line said from then on is an error."""

    class Unheard(Injected):
        def _say(self, text):
            super()._say(text)
            if self.injected_ns is not None:
                raise BrokenPipeError

    run = Unheard("press", HOLD_CYCLE, interrupted(signal.SIGINT))
    assert isinstance(run.error, KeyboardInterrupt)
    run.assert_drives_off()
    assert run.session.buses.truth["force_n"][-1] == 0.0
    assert {node.node.core.state for node in run.nodes.values()} == {NmtState.PRE_OPERATIONAL}
    assert any("BrokenPipeError" in fault for fault in run.session.cell.notes.lines())


def test_a_second_interrupt_stops_at_once():
    class Hurried(Injected):
        def record(self, row):
            self.rows += 1
            if self.rows == 10:
                signal.raise_signal(signal.SIGINT)

        def _say(self, text):
            super()._say(text)
            if text.startswith("lift off"):
                self.rows = 0
                self.session.cell.log.add = self.record

    run = Hurried("press", HOLD_CYCLE, interrupted(signal.SIGINT))
    assert isinstance(run.error, KeyboardInterrupt)
    run.assert_drives_off()
    back, _ = lifted(run)
    assert 0.2 * WAY_BACK < back < 0.5 * WAY_BACK, "10 of 64 cycles, the fast ones"


def test_a_way_back_on_which_the_force_grows_ends(monkeypatch):
    def misfeel(run):
        force = count(2.0, 0.02)
        monkeypatch.setattr(CycleState, "force", property(lambda _: next(force)))
        run.inject("node 4: mute")

    run = Injected("press", HOLD_CYCLE, misfeel)
    run.assert_drives_off()
    assert 0.0 < lifted(run)[0] < 0.5 * WAY_BACK


def test_an_own_controller_that_cannot_retreat_is_taken_off_at_the_force_limit():
    class Pressing(Injected):
        def command(self, measurement, command):
            self.task.targets["target_force_n"] = 4.0
            return self.task.step(measurement) if measurement.cycle < self.at else Command()

    run = Pressing("press", 5000, lambda _: None, own=True, limits={"force_max_n": 2.5})
    assert isinstance(run.error, SafetyStop) and "above the limit of 2.50 N" in str(run.error)
    run.assert_drives_off()
    assert 2.0 < run.session.buses.truth["force_n"].max() < 3.2
    assert run.session.buses.truth["force_n"][-1] == 0.0
