"""A cell that lost a node or its bus comes back: it waits, is brought up again, and holds until motion is asked for."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from recovering import HELD_CYCLES, LOSS_CYCLE, Enabled, Returning, Way

import canprobe
from canprobe.cell.master.conditions import BY_KEY
from canprobe.cell.master.controller import Command, Controller
from canprobe.cell.master.monitor import Monitor
from canprobe.cell.npz import read_npz
from canprobe.cell.session.recovery import PASSING
from canprobe.cell.session.session import Session
from canprobe.cli import main
from canprobe.errors import InterfaceError, NodeError, SafetyStop, UsageError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.protocol.frames import SYNC_ID, NmtCommand, pack_nmt


def test_losses_are_conditions_of_the_table():
    assert set(BY_KEY) >= PASSING


def test_a_drive_without_power_comes_back_and_nothing_is_lost_from_the_logs(tmp_path):
    run = Returning("node 3: reboot for 2500 ms", out=tmp_path).assert_came_back()
    assert run.steps("wait:") == ["wait: node 3 not there"]
    log = read_npz(tmp_path / "log.npz")
    times, rows = np.asarray(log["t_s"]), run.summary["cycle"]["cycles"]
    assert (np.diff(times) > 0.0).all() and len(times) == rows
    assert run.controllers[0].went_on[0] > LOSS_CYCLE + HELD_CYCLES
    frames = list(read_candump(tmp_path / "bus.log"))
    syncs = [t_ns for t_ns, _, can_id, _ in frames if can_id == SYNC_ID]
    assert len(syncs) == rows and np.diff(syncs).min() == 2_500_000, "the stop keeps the period"
    stamps = np.array([line[0] for line in frames])
    longest_s = np.diff(stamps[stamps > 1e9]).max() * 1e-9
    assert longest_s <= 0.101, "the nodes that stayed are heard all the time, every 100 ms"
    assert run.summary["completed"] and run.summary["sim_time_s"] == pytest.approx(times[-1] - times[0], abs=0.01)
    steps = (tmp_path / "steps.log").read_text().splitlines()
    assert [line[14:] for line in steps] == [line for line in run.said if not line.startswith("draw")]
    told = [float(line[:12]) for line in steps]
    assert told == sorted(told) and told[-1] > 2.5

    monitor = Monitor(run.opened.plan)
    monitor.push((can_id, data, t_ns) for t_ns, _, can_id, data in frames)
    events = [line.split("s   ")[1] for line in monitor.view(frames[-1][0]).events]
    seen = [events.index(step) for step in ("node 3: booted", "nodes 1-6: NMT command reset node")]
    assert seen == sorted(seen)
    assert any("no longer enabled" in event for event in events[seen[-1] :]), "it is stopped as the first one is"
    kinds = "\n".join(run.summary["faults"])
    words = ("node 3: lost: no usable TPDO .*", "the cell came back", "motion was asked for, and went on")
    lost_s, back_s, went_on_s = (float(re.search(rf"{one}, at ([\d.]+) s", kinds)[1]) for one in words)
    assert times[LOSS_CYCLE] < lost_s < times[LOSS_CYCLE] + 0.05
    assert 2.5 < back_s - lost_s < 3.0, "half a second after it booted"
    (back,) = run.steps("the cell is back after")
    assert float(back.split()[5]) == pytest.approx(back_s - lost_s, abs=0.1)
    assert went_on_s == pytest.approx(back_s + HELD_CYCLES * 0.0025, abs=0.02)


def somebody_resets(run):
    run.session.buses.lockstep.port().send_batch([pack_nmt(NmtCommand.RESET_NODE, 3)])


@pytest.mark.parametrize(
    "action",
    [
        "node 5: sync-lost for 300 ms",
        "node 1: heartbeat-off for 400 ms",
        "node 4: nmt command=129",
        "node 3: reboot for 100 ms;node 6: bus-off for 1200 ms",
    ],
)
def test_whatever_was_lost_comes_back(action, tmp_path, capsys):
    """And `canprobe judge` finds no fault of the master on the way."""
    Returning(action, out=tmp_path).assert_came_back()
    assert main(["judge", "free", "--record", str(tmp_path / "bus.log")]) == 0, capsys.readouterr().out


def test_somebody_who_resets_a_node_has_time_to_go_on():
    run = Returning(somebody_resets).assert_came_back()
    assert run.steps("lost: another master is on the bus")
    (back,) = run.steps("the cell is back after")
    assert float(back.split()[5]) > 2.0


class Busy(Participant):
    """A master that sends an NMT command again, one and a half seconds later."""

    next_deadline_ns = None

    def __init__(self, now_ns):
        self.next_deadline_ns = now_ns + 1_500_000_000

    def advance(self, t_ns):
        self.next_deadline_ns = None
        return [pack_nmt(NmtCommand.PRE_OPERATIONAL, 3)]


def test_somebody_who_goes_on_is_waited_for():
    def act(run):
        somebody_resets(run)
        run.session.buses.lockstep.attach(Busy(run.now()))

    run = Returning(act).assert_came_back()
    assert run.steps("wait:") == ["wait: another master is on the bus: an NMT command from another master"]


DOWN = "can0: interface is down; type: sudo ip link set can0 up"


def cut_for(seconds, *, replugged=False):
    """Take the interface away for a time; one that was replugged is another one, which has to be opened."""

    def cut(run):
        port, until_ns = run.session.cell.port, run.now() + round(seconds * 1e9)
        opened_ns = []

        def failing(method):
            def call(*arguments):
                if run.now() < until_ns or (replugged and not opened_ns):
                    raise InterfaceError(DOWN)
                return method(*arguments)

            return call

        def reopen(port):
            if run.now() < until_ns:
                raise InterfaceError(DOWN)
            opened_ns.append(run.now())
            return port

        run.session.buses.reopen = reopen
        for name in ("send_batch", "drain", "wait"):
            setattr(port, name, failing(getattr(port, name)))

    return cut


@pytest.mark.parametrize(("seconds", "replugged"), [(1.7, False), (1.7, True), (0.0, True)])
def test_an_interface_that_was_down_comes_back(seconds, replugged):
    """One that was replugged at once is opened at the loss."""
    run = Returning(cut_for(seconds, replugged=replugged)).assert_came_back()
    assert run.steps("wait:") == ([f"wait: {DOWN}"] if seconds else [])


class Nod(Controller):
    """Ends a little after the loss; it does not say that it can go on."""

    went_on = ()

    def step(self, measurement):
        return Command(done=measurement.cycle > LOSS_CYCLE + 80)


def test_a_controller_that_cannot_go_on_ends_and_the_next_one_finds_the_cell_up():
    run = Returning("node 3: reboot for 500 ms", controller=Nod, again=True)
    (error,) = run.errors
    assert isinstance(error, NodeError) and error.node_id == 3
    lost, back = run.said.index(run.steps("lost: ")[0]), run.said.index(run.steps("the cell is back")[0])
    assert lost < back and run.said[back - 1] == "enable the drives"
    assert max(distance for (_, time), distance in run.enabled.distances.items() if time > 1) <= 1


def test_an_array_that_was_switched_off_comes_back():
    class Listen(Way):
        def step(self, measurement):
            self.left -= measurement.cycle >= LOSS_CYCLE
            return Command(done=self.left <= 0)

    run = Returning("node 16: reboot for 800 ms", "listen", controller=Listen)
    assert not run.errors and len(run.controllers[0].went_on) == 1
    assert run.steps("lost: no tactile frame for 13 cycles") and run.steps("wait: node 16 not there")
    ages = np.asarray(run.session.cell.log.arrays()["tactile_age"])
    assert ages.max() == 13, "the cycle that found it has its row"


def test_a_node_that_is_lost_between_two_controllers_is_waited_for():
    class Short(Nod):
        def step(self, measurement):
            return Command(done=measurement.cycle >= LOSS_CYCLE + 60)

    run = Returning("node 3: reboot at 149 ms for 900 ms", controller=Short, again=True)
    assert not run.errors and len(run.controllers) == 2
    assert len(run.steps("the cell is back")) == 1 and run.said.count("enable the drives") == 3


def homed_scene(*, store=False):
    """A scene whose third joint has no absolute encoder."""
    scene = canprobe.load_scene("free")
    name = list(scene.joints)[2]
    joint = replace(scene.joints[name], zero="homing", homing_method=37, home_deg=0.0)
    return replace(scene, joints={**scene.joints, name: joint}, bring_up=replace(scene.bring_up, store=store))


def out_of_reach_and_silent(run):
    """It does not show that it kept its power."""
    run.inject("node 3: bus-off for 2500 ms")
    run.nodes[3].dictionary.entries.pop(0x101601)


@pytest.mark.parametrize(
    ("what", "store"),
    [
        ("node 3: reboot for 300 ms", False),
        ("node 3: bus-off for 2500 ms;node 3: reboot at 1 s for 100 ms", False),
        ("node 3: bus-off for 2500 ms", True),
        (out_of_reach_and_silent, False),
    ],
)
def test_a_drive_that_counts_increments_and_may_have_been_without_power_is_homed_again(what, store):
    """Where nobody heard its boot-up, what it had in its memory is gone; what it stores says nothing."""
    run = Returning(what, homed_scene(store=store))
    (error,) = run.errors
    assert "node 3: (joint 3) is not homed" in str(error)
    assert "type: canprobe home free --bus socketcan --channel can0" in str(error)
    assert {time for _, time in run.enabled.distances} == {1}, "no drive was enabled after it"


@pytest.mark.parametrize("out_of_reach_ms", [900, 2500])
def test_a_drive_that_counts_increments_and_kept_its_power_keeps_its_zero(out_of_reach_ms):
    """It was released at the stop; or it was out of reach then, and still holds what bring-up has written."""
    Returning(f"node 3: bus-off for {out_of_reach_ms} ms", homed_scene()).assert_came_back()


def test_an_arm_that_reports_another_place_is_not_enabled():
    run = Returning("node 3: reboot for 300 ms;node 3: zero-shift on operational")
    (error,) = run.errors
    assert isinstance(error, SafetyStop)
    assert re.match(r"joint 3 reports -\d+\.\d\d deg, and reported 1\d\.\d\d deg before the loss", str(error))
    assert {time for _, time in run.enabled.distances} == {1}


def test_a_device_error_waits_for_somebody_to_switch_the_drive_off_and_on():
    run = Returning("node 3: drive-fault;node 3: reboot at 5 s for 500 ms").assert_came_back()
    assert run.steps("wait: node 3 reported an error of the device: see to it, then switch it off and on")


def test_a_drive_whose_torque_was_taken_off_ends_the_run_as_ever():
    run = Returning("node 3: sto for 100 ms")
    assert "left operation enabled: SWITCH_ON_DISABLED" in str(run.errors[0]) and not run.steps("lost: ")


def test_a_node_that_never_returns_ends_the_wait_with_the_loss():
    run = Returning("node 3: reboot for 1000 s")
    assert "node 3: lost: no usable TPDO" in str(run.errors[0]) and not run.steps("the cell is back")


def test_resume_needs_a_cell_that_recovers():
    with canprobe.open_cell("free") as cell, pytest.raises(UsageError, match="not opened with recover=True"):
        cell.resume()


def test_a_second_controller_begins_where_the_arm_stands():
    session = Session(canprobe.load_scene("free", {"bus.timed": False}))
    watcher = Enabled(session.buses.world.nodes)
    session.buses.world.participants.append(watcher)

    def steps_ahead(measurement):
        ahead = 0.004 if measurement.cycle > 200 else 0.0
        return Command(q_target=measurement.q + ahead, done=ahead > 0.0)

    with session:
        session.run(steps_ahead)
        session.run(lambda measurement: Command(done=measurement.cycle > 300))
    assert max(distance for (_, time), distance in watcher.distances.items() if time == 2) <= 1
