"""Every row of the table of conditions: injected in lockstep, seen within its time, and answered as the table says."""

from __future__ import annotations

import math
import re
import signal
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain, count, repeat
from pathlib import Path
from struct import pack, unpack

import numpy as np
import pytest
from cut_port import CutPort
from full_disk import room_for
from injected import FREE_CYCLE, HOLD_CYCLE, SCAN_CYCLE, Injected, altered, send

import canprobe
from canprobe.cell.master.conditions import BY_KEY, CONDITIONS
from canprobe.cell.master.controller import Command
from canprobe.cell.master.options import RunOptions
from canprobe.cell.master.supervision import Reaction
from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.scene.geometry import true_object
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.task import Phase
from canprobe.errors import CanprobeError, InterfaceError, NodeError, ResultsError, SafetyStop
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.port import ControllerState
from canprobe.fieldbus.protocol.cia402 import DriveState, state_of
from canprobe.fieldbus.protocol.emcy import Emcy
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, SYNC_ID, NmtCommand, NmtState, pack_nmt

# what ends a run with one cause and one answer


def thrown(text):
    return lambda run: run.inject(text)


def says(node_id, can_id, change=lambda _: None):
    """A node sends an identifier with other data, or no more."""
    return lambda run: altered(run.nodes[node_id], can_id, change)


def sends(can_id, data):
    return lambda run: send(run, (can_id, data))


def in_state(state):
    def change(run):
        run.session.cell.port.state = state

    return change


def raising(error):
    def raise_it(run):
        raise error

    return raise_it


def vanish(run):
    run.session.buses.world.plant.place(None)


def moved(data, counts):
    return data[:2] + pack("<i", unpack("<i", data[2:6])[0] + counts) + data[6:]


def turned(data, counts):
    return pack("<I", unpack("<I", data)[0] + counts)


PASSIVE = in_state(ControllerState.PASSIVE)
FOREIGN = "another master is on the bus: an NMT command from another master"
NO_STATE = "node 3: (joint 3) left operation enabled: in no CiA 402 state (statusword 0x0601)"
UNHEARD = "lost: no usable TPDO for 6 cycles"


@pytest.mark.parametrize(
    ("key", "scene", "action", "told", "error", "more"),
    [
        ("heartbeat", "free", thrown("node 3: heartbeat-off"), "node 3: lost: no heartbeat", NodeError, {}),
        ("nmt_state", "free", thrown("node 2: reboot for 1 ms"), "node 2: left operation: NMT state", NodeError, {}),
        ("drive_fault", "free", thrown("node 2: drive-fault"), "4310h", NodeError, {}),
        ("drive_fault", "free", says(3, 0x183, lambda d: b"\x01\x06" + d[2:]), NO_STATE, NodeError, {}),
        ("foreign_master", "free", sends(SYNC_ID, b""), "another master is on the bus", SafetyStop, {}),
        *(
            ("foreign_master", "free", sends(*pack_nmt(*command)), FOREIGN, SafetyStop, {})
            for command in ((NmtCommand.STOP, 0), (NmtCommand.PRE_OPERATIONAL, 3), (NmtCommand.RESET_NODE, 0))
        ),
        ("drive_silent", "free", says(5, 0x185), f"node 5: {UNHEARD}", NodeError, {}),
        ("drive_silent", "free", says(2, 0x182, lambda d: moved(d, 2000)), f"node 2: {UNHEARD}", NodeError, {}),
        ("sensor_stale", "press", says(16, 0x511), "no tactile frame for 7 cycles", SafetyStop, {}),
        ("error_passive_long", "press", PASSIVE, "error-passive for 1.0 s", CanprobeError, {"until": 1500}),
        ("bus_off", "free", in_state(ControllerState.BUS_OFF), "bus-off", InterfaceError, {}),
        ("carrier", "turntable", says(17, 0x191), "node 17: (carrier) lost: no usable position for", NodeError, {}),
        ("carrier", "turntable", says(17, 0x191, lambda d: turned(d, 100)), "a jump by 0.15 deg", NodeError, {}),
        ("force_fell", "press", vanish, "the measured force fell from", SafetyStop, {}),
        ("force_fell", "cylinder", vanish, "or the object was taken away", SafetyStop, {"task": {"regain_mm": 0.0}}),
        ("interrupt", "free", raising(KeyboardInterrupt), "", KeyboardInterrupt, {}),
        ("interrupt", "free", raising(ZeroDivisionError), "", ZeroDivisionError, {}),
    ],
)
def test_a_cause_is_answered_within_its_time_and_told(key, scene, action, told, error, more):  # noqa: PLR0917
    run = Injected(scene, {"free": FREE_CYCLE, "press": HOLD_CYCLE}.get(scene, SCAN_CYCLE), action, **more)
    run.assert_within(key).assert_drives_off()
    assert isinstance(run.error, error) and told in str(run.error)
    assert told not in (FOREIGN, NO_STATE) or str(run.error) == told
    if told == NO_STATE:
        assert run.session.cell.notes.lines() == ["while stopping: node 3 did not confirm that it is disabled"]
    if scene in ("press", "turntable"):
        assert run.session.buses.truth["force_n"][-1] == 0.0
    if scene != "press":
        assert np.abs(np.diff(run.session.buses.truth["q_rad"], axis=0)).max() < 0.01, "no joint jumps"


# nodes


def test_an_emcy_of_the_sensor():
    def alarm(run):
        run.nodes[16].node.emcy.report(0x5000)
        send(run, (0x7A0, b""))  # a frame wakes the bus, which then carries the EMCY
        run.session.buses.lockstep._queue(run.session.buses.lockstep._nodes[6], run.nodes[16].node._taken())

    run = Injected("press", HOLD_CYCLE, alarm)
    run.assert_within("emcy").assert_drives_off()
    assert str(run.error) == "node 16: EMCY 5000h, device hardware"


def test_an_emcy_about_communication_is_noted():
    run = Injected("free", FREE_CYCLE, lambda r: send(r, (EMCY_BASE + 4, Emcy(0x8210, 0x11).pack())), until=10)
    run.assert_counted("emcy_communication")
    at_s = run.session.cell.cycles.start_ns * 1e-9 + FREE_CYCLE * 0.0025
    told = f"node 4: EMCY 8210h, PDO not processed due to length error, at {at_s:.2f} s"
    assert run.session.cell.notes.lines() == [told]


@pytest.mark.parametrize("step", ["identify", "start all", "enable"])
def test_another_master_that_interferes_before_the_run_is_named_and_nothing_is_enabled(step):
    said = []

    def say(text):
        said.append(text)
        if text.startswith(step):
            session.buses.lockstep.port().send_batch([pack_nmt(NmtCommand.STOP, 4)])

    session = Session(canprobe.load_scene("free"), RunOptions(say=say))
    with pytest.raises(CanprobeError, match="an NMT command from another master"), session:
        session.run(lambda _: Command())
    assert said[-1] != "enable the drives" or session.cell.log.arrays()["statusword"].size
    for row in session.cell.log.arrays().get("statusword", ()):
        assert DriveState.OPERATION_ENABLED not in map(state_of, map(int, row))


def not_enabled(told, *changes):
    """Ends so where something is done to the session from `enable the drives` on."""

    def say(text):
        if text == "enable the drives":
            for change in changes:
                change(session)

    session = Session(canprobe.load_scene("free"), RunOptions(say=say))
    session.buses.world.make_faulty()
    with pytest.raises(CanprobeError, match=told), session:
        session.run(lambda _: Command(done=True))
    words = session.cell.log.arrays()["statusword"]
    assert DriveState.OPERATION_ENABLED not in {state_of(int(word)) for word in words.ravel()}


def from_node(node_id, cob_id, change):
    """A node sends other data."""
    return lambda session: altered(session.buses.world.participants[node_id - 1], cob_id, change)


def test_bus_off_and_an_emergency_while_the_drives_are_being_enabled_end_that():
    not_enabled("bus-off", lambda session: setattr(session.cell.port, "state", ControllerState.BUS_OFF))
    alarm = EMCY_BASE + 4, Emcy(0x4210, 1).pack()
    not_enabled("EMCY 4210h", lambda session: session.buses.lockstep.port().send_batch([alarm]))


def test_an_arm_that_does_not_stand_still_is_not_enabled():
    way = count(0, 20)
    not_enabled("node 2: reports no position that stays for 2 s", from_node(2, 0x182, lambda d: moved(d, next(way))))


def test_a_jump_while_the_drives_are_being_enabled_ends_that():
    ready = DriveState.READY_TO_SWITCH_ON
    change = lambda d: moved(d, 20_000) if state_of(unpack("<H", d[:2])[0]) is ready else d  # noqa: E731
    not_enabled("joint 2 reports a motion of", from_node(2, 0x182, change))


def test_a_heartbeat_that_is_lost_before_the_drives_are_enabled_ends_that():
    """They are enabled only once joint 2 stands still, which here takes longer than the time-out."""
    way = chain(range(0, 3000, 20), repeat(3000))
    not_enabled(
        "node 3: lost: no heartbeat",
        from_node(2, 0x182, lambda d: moved(d, next(way))),
        from_node(3, HEARTBEAT_BASE + 3, lambda _: None),
    )


def test_a_moving_arm_is_stopped_before_it_is_disabled():
    """A drive that loses its power while it moves coasts."""
    sent = []

    def interrupt(run):
        inner = run.session.buses.lockstep.recorder

        def recorder(can_id, data, t_ns):
            sent.append((can_id, data[:2]))
            inner(can_id, data, t_ns)

        run.session.buses.lockstep.recorder = recorder
        raise KeyboardInterrupt

    Injected("free", FREE_CYCLE, interrupt).assert_drives_off()
    for cob_id in range(0x201, 0x207):
        words = [int.from_bytes(word, "little") for can_id, word in sent if can_id == cob_id]
        assert list(dict.fromkeys(words))[:2] == [0x02, 0x00]


class NeverHeard(Injected):
    """An array that lives and sends no frame."""

    def _run(self):
        for pdo in self.session.plan.pdos_of(16, "tpdo"):
            altered(self.nodes[16], pdo.cob_id, lambda _: None)
        super()._run()


def test_an_own_controller_does_not_go_on_with_an_array_that_was_never_heard():
    run = NeverHeard("press", FREE_CYCLE, lambda _: None, own=True)
    assert "no tactile frame for" in str(run.error)
    assert run.injected_ns is None, "it came to no cycle of a touch"


# PDOs


@pytest.mark.parametrize("fault", ["drop for 8 ms", "delay ms=2 for 8 ms", "short count=2"])
def test_missed_pdos_are_lived_with(fault):
    run = Injected("free", FREE_CYCLE, lambda r: r.inject(f"node 5: {fault}"), until=20)
    run.assert_counted("pdo_missed")
    if fault.startswith("short"):
        assert run.session.cell.drives.malformed > 0


@pytest.mark.parametrize(
    ("fault", "key"), [("corrupt for 15 ms", "torn_frame"), ("wrong-data seed=4 for 15 ms", "sync_mismatch")]
)
def test_a_wrong_frame_of_the_array_is_not_used(fault, key):
    run = Injected("press", HOLD_CYCLE, lambda r: r.inject(f"node 16: {fault}"), until=40)
    run.assert_counted(key)
    assert run.session.buses.truth["force_n"].max() < 3.0


def test_a_drive_that_is_late_makes_all_of_them_hold():
    """Five cycles without node 5: the others have their last targets once more, then they stand, then all go on."""
    run = Injected("free", FREE_CYCLE, lambda r: r.inject("node 5: mute for 11 ms"), until=40)
    assert run.error is None
    noticed = run.session.cell.supervisor.first["drive_late"]
    assert 0 < (noticed - run.at) * run.limits.period_ns <= BY_KEY["drive_late"].within(run.limits)
    log = run.session.cell.log.arrays()
    assert np.isnan(log["q_target_rad"][noticed]).all(), "no new ones"
    stands = np.abs(log["q_target_rad"][noticed + 1] - log["q_rad"][noticed + 1])
    assert np.delete(stands, 4).max() < 2e-4, "on the way, next to where those are that are heard"
    assert any("node 5: no usable TPDO for 3 cycles: hold" in fault for fault in run.session.cell.notes.lines())


def test_a_wrong_position_is_not_believed():
    def lie(run):
        run.lie = altered(run.nodes[2], 0x182, lambda d: moved(d, 60))

    class Liar(Injected):
        def after(self, measurement):
            if measurement.cycle == self.at + 2:
                self.nodes[2].remove(self.lie)

    run = Liar("free", FREE_CYCLE, lie, until=40)
    run.assert_counted("pdo_missed")
    assert 2 <= run.session.cell.drives.implausible <= 3
    q = run.session.cell.log.arrays()["q_rad"][run.at - 5 : run.at + 10, 1]
    truth = run.session.buses.truth["q_rad"][run.at - 5 : run.at + 10, 1]
    assert np.abs(q - truth).max() < 1e-3 < 60 / 7000, "sixty counts are 5 mrad"


# the bus


def test_error_frames_dropped_frames_and_a_wall_clock_that_is_set_are_noted():
    def count(run):
        run.session.cell.port.counters.error_frames += 3
        run.session.cell.port.counters.overruns += 2
        run.session.cell.port.counters.clock_steps += 1

    run = Injected("free", FREE_CYCLE, count, until=10)
    run.assert_counted("error_frames").assert_counted("frames_dropped").assert_counted("clock_step")
    assert f"wall clock set: 1, the first in cycle {FREE_CYCLE + 1}" in run.session.cell.notes.lines()
    assert any("bus error frames: 3" in fault for fault in run.session.cell.notes.lines())
    assert any("dropped by the kernel or the controller: 2" in fault for fault in run.session.cell.notes.lines())


class Passive(Injected):
    """Error-passive for a while."""

    for_cycles = 40

    def after(self, measurement):
        if measurement.cycle == self.at + self.for_cycles:
            self.session.cell.port.state = ControllerState.ACTIVE


def test_error_passive_holds_until_it_is_over():
    run = Passive("free", FREE_CYCLE, PASSIVE, until=100)
    assert run.error is None
    targets = run.session.cell.log.arrays()["q_target_rad"]
    stands = (np.diff(targets, axis=0) == 0.0).all(axis=1)
    assert stands[run.at + 2 : run.at + run.for_cycles].all()
    assert not stands[run.at - 20 : run.at].any() and not stands[run.at + run.for_cycles + 2 : run.until - 1].any()
    assert any("error-passive: hold" in fault for fault in run.session.cell.notes.lines())


@pytest.mark.parametrize("back_after_ns", [math.inf, 100_000_000])
def test_the_interface_is_removed_and_the_drives_stop_by_themselves(back_after_ns):
    def remove(run):
        cell, gone_ns = run.session.cell, run.now()
        gone = CutPort(cell.port, gone_ns, gone_ns + back_after_ns)
        cell.port = cell.cycles.port = cell.cycle._port = cell._network.port = gone

    run = Injected("free", FREE_CYCLE, remove)
    run.assert_within("interface").assert_drives_off()
    assert isinstance(run.error, InterfaceError) and "it is gone" in str(run.error)
    assert any("while stopping" in fault for fault in run.session.cell.notes.lines()) is (back_after_ns == math.inf)


# time


class Late(Injected):
    """Every cycle comes late from one on."""

    def command(self, measurement, command):
        if measurement.cycle >= self.at:
            clock = self.session.buses.lockstep.clock
            clock.sleep_until_ns(clock.now_ns() + 8 * self.limits.period_ns // 5)
        return command


def test_the_overrun_budget_makes_the_probe_retreat():
    run = Late("press", HOLD_CYCLE, lambda _: None, until=1000)
    assert "of the last second's cycles came more than half a period late" in str(run.error)
    run.assert_within("overruns")
    assert run.session.buses.truth["force_n"][-1] == 0.0


# the touch and the arm


def test_force_above_the_limit_makes_the_probe_retreat():
    def squeeze(run):
        run.task.targets["target_force_n"] = 4.0

    run = Injected("press", HOLD_CYCLE, squeeze, limits={"force_max_n": 3.0})
    assert "above the limit of 3.00 N" in str(run.error)
    above = np.flatnonzero(run.session.buses.truth["force_n"] > 1.03 * 3.0)[0]
    retreat = np.flatnonzero(run.session.cell.log.arrays()["phase"] == Phase.RETREAT)[0]
    assert 0 < (retreat - above) * run.limits.period_ns <= BY_KEY["force"].within(run.limits)
    run.assert_drives_off()
    assert run.session.buses.truth["force_n"][-1] == 0.0


def test_contact_lost_in_a_scan_makes_it_search_and_then_retreat():
    """The object sinks faster than the probe follows; it retreats when it has searched as far as it may."""

    class Sinking(Injected):
        gone_ns = None

        def command(self, measurement, command):
            if self.injected_ns is not None and (sunk := (measurement.cycle - self.at) * 2.5e-3 * 12.0) < 8.0:
                plant, given = self.session.buses.world.plant, self.session.scene.object
                moved = tuple(np.subtract(given.position_mm, (0.0, 0.0, sunk)))
                plant.place(true_object(replace(given, position_mm=moved)))
            if self.gone_ns is None and self.task.losses and self.task.losses[0].searched > self.limits.regain:
                self.gone_ns = self.now()
            return command

    run = Sinking("cylinder", SCAN_CYCLE, lambda _: None, until=1000, task={"regain_mm": 1.0})
    limit = BY_KEY["contact_not_regained"].within(run.limits)
    assert 0 <= run.answered_ns - run.gone_ns <= limit
    assert str(run.error) == "contact lost, and not found again within 1.0 mm"
    run.assert_drives_off()


def test_a_saturated_array_makes_the_probe_retreat():
    class Saturated(Injected):
        saturated_ns = None  # since when without a break

        def command(self, measurement, command):
            if measurement.tactile is not None and self.answered_ns is None:
                first = self.saturated_ns or self.now()
                self.saturated_ns = first if self.task.sensing.patch.saturated else None
            return command

    stiff = {"plant": {"stiffness_n_m3": 1.4e10}}  # 0.1 MN/m: a few taxels carry all of it
    slow = {"servo": {"surface_height_hz": 2.0}, "cycle": {"rate_hz": 400.0}}
    run = Saturated("press", FREE_CYCLE, lambda _: None, until=1000, **stiff, **slow)
    assert "the array is saturated and no stiffness was measured" in str(run.error)
    assert 0 < run.answered_ns - run.saturated_ns <= BY_KEY["force_hidden"].within(run.limits)
    assert run.session.buses.truth["force_n"][-1] == 0.0


def own_target(change):
    class Own(Injected):
        def command(self, measurement, command):
            if measurement.cycle < self.at:
                return command
            return Command(q_target=change(measurement.q))

    return Own


def test_an_own_controller_cannot_leave_the_joints_range():
    run = own_target(lambda q: q + np.array([0, 0, 0, 0, 3.0, 0]))("free", FREE_CYCLE, lambda _: None, own=True)
    run.assert_within("joint_stop").assert_drives_off()
    assert "joint 5 at" in str(run.error) and "its stop" in str(run.error)
    q = run.session.buses.truth["q_rad"]
    assert np.abs(q[-1] - q[FREE_CYCLE - 20]).max() < 1e-3


@pytest.mark.parametrize("target", [np.full(6, np.nan), np.zeros(5), "home"])
def test_an_own_controllers_target_that_is_none(target):
    run = own_target(lambda q: target)("free", FREE_CYCLE, lambda _: None, own=True)
    run.assert_within("joint_stop").assert_drives_off()
    assert re.search("expected 6 (finite )?angles", str(run.error))


def test_an_own_controllers_jump_is_made_at_the_joints_speed():
    run = own_target(lambda q: np.radians([90, 65, 15, 20, 100, 0.0]))("free", FREE_CYCLE, lambda _: None, own=True)
    run.assert_counted("target_speed")
    q = run.session.buses.truth["q_rad"]
    speeds = np.abs(np.diff(q[:, 3])) / 2.5e-3
    assert np.degrees(speeds.max()) < 1.2 * 675
    assert np.degrees(q[-1, 3]) == pytest.approx(20, abs=1.0)


def test_the_workspace_ends_a_press():
    run = Injected("press", 5000, lambda _: None, limits={"workspace_min_mm": (-500.0, -500.0, 375.0)})
    assert "the probe's tip at z =" in str(run.error) and "workspace ends at 375.0 mm" in str(run.error)
    assert run.session.buses.truth["force_n"].max() == 0.0


def test_the_workspace_ends_an_own_controllers_motion():
    scene = canprobe.load_scene("free")
    T_base_tip_of = JointGuard(canprobe.plan(scene)).T_base_tip
    start = 1e3 * T_base_tip_of(canprobe.plan(scene).setup.arm.q_start)[:3, 3]
    up = own_target(lambda q: q + np.array([0, 0.02, 0, 0, 0, 0]))
    run = up("free", FREE_CYCLE, lambda _: None, own=True, limits={"workspace_max_mm": tuple(start + 15.0)})
    assert isinstance(run.error, SafetyStop) and "workspace ends at" in str(run.error)
    tips = np.array([T_base_tip_of(q)[:3, 3] for q in run.session.buses.truth["q_rad"][::5]])
    assert (1e3 * tips < start + 15.0 + 3.0).all()
    run.assert_drives_off()


def test_a_drive_that_is_never_in_a_state_is_not_enabled():
    session = Session(canprobe.load_scene("free"))
    altered(session.buses.world.make_faulty().nodes[2], 0x183, lambda d: b"\x01\x06" + d[2:])
    told = r"node 3: \(joint 3\) is in no CiA 402 state \(statusword 0x0601\) 2 s after the command to enable operation"
    with pytest.raises(NodeError, match=told), session:
        session.run(lambda _: Command())
    assert {node.state for node in session.buses.world.nodes} == {NmtState.PRE_OPERATIONAL}


def test_a_measured_jump_that_no_joint_can_make():
    """Where the guard of the positions is off, as it is until the drives are enabled."""

    class Unguarded(Injected):
        def after(self, measurement):
            self.session.cell.cycles.controller.compares_motion = True
            for track in self.session.cell.drives.tracks:
                track._asked = 1e9

    run = Unguarded("free", FREE_CYCLE, says(2, 0x182, lambda d: moved(d, 2000)))
    run.assert_within("joint_speed").assert_drives_off()
    assert "joint 2 reports a motion of" in str(run.error)


def test_an_estimator_that_diverges_starts_afresh():
    def diverge(run):
        estimator = run.task.shape._estimator
        original, done = estimator.answering, []

        def once():
            estimate = yield from original()
            if not done and estimate is not None and estimate.observed.all():
                done.append(True)
                return replace(estimate, kappa=np.array([5e3, 0.0]))
            return estimate

        estimator.answering = once

    run = Injected("cylinder", SCAN_CYCLE, diverge, until=200, shape={"also": ()})
    assert run.error is None
    assert run.session.cell.supervisor.counts["estimator"] == run.task.shape.restarts == 1
    assert any("estimator diverges: 1" in fault for fault in run.session.cell.notes.lines())
    assert max(float(np.abs(r.estimate.kappa[0])) for r in run.task.shape.records if r.estimate.observed[0]) < 100


# outside


@pytest.mark.parametrize(("hung_ns", "waits"), [(20_000_000, True), (1_100_000_000, False)])
def test_an_interrupt_does_not_wait_for_a_controller_that_hangs(hung_ns, waits):
    reached = []

    def hang(run):
        clock = run.session.buses.lockstep.clock
        clock.sleep_until_ns(clock.now_ns() + hung_ns)
        signal.raise_signal(signal.SIGINT)
        reached.append(True)

    run = Injected("free", FREE_CYCLE, hang, arm={"missed_syncs": 40})
    run.assert_drives_off()
    assert isinstance(run.error, KeyboardInterrupt) and bool(reached) is waits


def test_the_drives_of_a_dead_master_stop_by_themselves():
    seen = {}

    def die(run):
        clock, start = run.session.buses.lockstep.clock, run.now()
        limit = BY_KEY["master_dead"].within(run.limits)
        clock.sleep_until_ns(start + limit - run.limits.period_ns)
        seen["before"] = [state_of(run.nodes[i].node.dictionary.number(0x6041)) for i in range(1, 7)]
        clock.sleep_until_ns(start + limit + 1)
        seen["after"] = [state_of(run.nodes[i].node.dictionary.number(0x6041)) for i in range(1, 7)]

    run = Injected("free", FREE_CYCLE, die)
    assert seen["before"] == [DriveState.OPERATION_ENABLED] * 6
    assert DriveState.OPERATION_ENABLED not in seen["after"]
    assert isinstance(run.error, NodeError)


def test_a_full_disk(tmp_path):
    class OnDisk(Injected):
        def _run(self):
            self.session.options = replace(self.session.options, out=tmp_path)
            super()._run()

    log = tmp_path / "bus.log"
    with ExitStack() as stack:
        run = OnDisk("press", HOLD_CYCLE, lambda _: stack.enter_context(room_for(log.stat().st_size + 3000)))
    assert str(run.error) == f"{log}: cannot be written: File too large"
    assert isinstance(run.error, ResultsError)  # after the task has let go
    run.assert_drives_off()
    assert run.session.buses.truth["force_n"][run.at] > 1.8 and run.session.buses.truth["force_n"][-1] == 0.0
    assert log.read_text().endswith("\n") and len(list(read_candump(log))) > 1000


def test_every_row_is_tested_here():
    source = Path(__file__).read_text(encoding="utf-8")
    for name in (
        "test_preload.py",
        "test_off_pad.py",
        "test_dead_taxels.py",
        "test_way_back.py",
        "test_blind_array.py",
    ):
        source += Path(__file__).with_name(name).read_text(encoding="utf-8")
    special = {
        "error_passive": "error-passive: hold",
        "force": 'BY_KEY["force"]',
        "image_dead": "node 16: stuck-image",
        "depth": "node 16: replayed-image",
        "push_unfelt": "torques of the drives show a push of",
        "contact_lost": "contact lost, and not found again",
        "contact_to_regain": "losses[0].searched",
        "log": "test_a_full_disk",
    }
    for condition in CONDITIONS:
        assert special.get(condition.key, f'"{condition.key}"') in source, condition.key
    assert {c.reaction for c in CONDITIONS} == set(Reaction)
