"""Each check of the table of conditions at its limit and just beyond it: the runs that inject faults go far beyond."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from canprobe.cell.master.conditions import BY_KEY, CONDITIONS
from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.drives import DriveAxis
from canprobe.cell.master.supervision import CycleState, Limits, Reaction, TouchState
from canprobe.cell.master.supervisor import Supervisor
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.scene.setup import SafetyLimits
from canprobe.fieldbus.bus.port import ControllerState, PortCounters
from canprobe.fieldbus.protocol.cia402 import DriveState
from canprobe.fieldbus.protocol.emcy import Emcy
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, SYNC_ID, NmtState
from canprobe.mechanics.touch.depth_witness import Fall
from canprobe.mechanics.touch.image.force_errors import ForceSigma

LIMITS = Limits(SafetyLimits(5.0, 0.15, 0.0, 1.0, 0.8, None), period_ns=2_500_000)
SCANNING = replace(LIMITS, regain=3e-3)
TARING = replace(LIMITS, tares=True)
COMMUNICATION, TEMPERATURE = Emcy(0x8210, 0x11).pack(), Emcy(0x4210, 0x09).pack()


def seen(limits=LIMITS, **fields):
    return CycleState(limits, NodeWatch((1, 2)), None, None, PortCounters(), **fields)


def passive(time_ns):
    """A cell whose CAN controller has been error-passive for a time."""
    return seen(passive_ns=time_ns, controller_state=ControllerState.PASSIVE)


def with_ages(*ages):
    """Two drives that were heard last so many cycles ago."""
    found = seen(measurement=Measurement(100, 0, q_age=ages))
    found.drives = SimpleNamespace(axes=[DriveAxis(1, (), ()), DriveAxis(2, (), ())])
    return found


def check(key):
    return BY_KEY[key].check


def touch(force=2.0, age=2, lost_s=0.0, limits=LIMITS, **more):
    return TouchState(limits, force, age, lost_s, **more)


def scan(lost_s=0.0, **more):
    """A scan that may search for its contact."""
    return touch(lost_s=lost_s, path=True, limits=SCANNING, **more)


def heard(can_id, *data):
    """A cell whose nodes are operational, after one more frame."""
    found = seen()
    for node_id in (1, 2):
        found.watch.push(HEARTBEAT_BASE + node_id, bytes((NmtState.OPERATIONAL,)), 0)
    found.watch.push(can_id, bytes(data), 0)
    return found


def images(dead_since_ns):
    return SimpleNamespace(dead_since_ns=dead_since_ns, words="the array has sent the same image")


def depth(fallen_s=None, **more):
    """The depth's witness, of a force that fell so long ago."""
    fall = None if fallen_s is None else Fall(1.0, 5e-3, 2.0, 0.5, fallen_s)
    return SimpleNamespace(**{"fall": fall, "contradicts": False, "wandered": None, "force": 6.0, **more})


def felt(**patch):
    return SimpleNamespace(sigma=ForceSigma(), **patch)


@pytest.mark.parametrize(
    ("key", "within", "beyond", "told"),
    [
        ("force", touch(5.0), touch(5.001), "5.00 N above the limit of 5.00 N"),
        ("force", touch(4.8, force_sigma=0.1), touch(4.8, force_sigma=0.101), "4.80 N, or up to 5.00 N (2σ), above"),
        ("force", touch(4.9, force_sigma=math.inf), touch(5.001, force_sigma=math.inf), "above the limit of 5.00 N"),
        ("sensor_stale", touch(age=12), touch(age=13), "no tactile frame for 13 cycles"),
        ("sensor_stale", touch(age=None), touch(age=20), "no tactile frame for 20 cycles"),
        ("contact_lost", touch(lost_s=0.0299), touch(lost_s=0.0301), "contact lost"),
        ("drive_late", with_ages(0, 2), with_ages(0, 3), "node 2: no usable TPDO for 3 cycles"),
        ("drive_silent", with_ages(5, 0), with_ages(6, 0), "node 1: lost: no usable TPDO for 6 cycles"),
        ("overruns", seen(late_share=0.8), seen(late_share=0.81), "81.0 % of the last second's cycles"),
        ("error_passive_long", passive(1_000_000_000), passive(1_002_500_000), "error-passive for 1.0 s"),
        ("error_passive", passive(1_000_000_001), passive(1_000_000_000), "error-passive"),
        ("bus_off", passive(0), seen(controller_state=ControllerState.BUS_OFF), "bus-off"),
        ("force_hidden", touch(hidden_s=0.02), touch(hidden_s=0.0201), "force is above the 2.0 N measured"),
        ("off_pad", touch(off_pad_s=0.02), touch(off_pad_s=0.0201), "runs off the edge of the array"),
        ("taxels_hidden", touch(bridged_s=0.02), touch(bridged_s=0.0201, bridged=0.6), "60 % of the force"),
        ("contact_lost", scan(0.1), replace(scan(0.0301), path=False), "contact lost"),
        ("contact_lost", touch(lost_s=0.03, path=True), touch(lost_s=0.0301, path=True), "contact lost"),
        ("contact_to_regain", scan(0.03), scan(0.0301), "contact lost"),
        ("contact_to_regain", touch(lost_s=0.1), scan(0.1), "contact lost"),
        ("image_dead", touch(images=images(None)), touch(images=images(7)), "sent the same image: it does not measure"),
        ("force_fell", touch(depth=depth(0.0499)), touch(depth=depth(0.0501)), "fell from 2.00 to 0.50 N within 5 ms"),
        ("contact_lost", touch(lost_s=0.1, depth=depth(0.01)), touch(lost_s=0.1), "contact lost"),
        ("contact_to_regain", scan(0.1, depth=depth(0.01)), scan(0.1), "contact lost"),
        ("depth", touch(depth=depth()), touch(depth=depth(contradicts=True)), "2.00 N where the probe's depth"),
        ("depth", touch(depth=depth()), touch(depth=depth(contradicts=True, wandered=1.2e-3)), "1.2 mm aside"),
        ("push_unfelt", seen(), seen(unfelt=3.4, patch=felt(force=0.2)), "3.4 N beyond the 0.20 N that the array"),
        ("contact_not_regained", scan(searched=3e-3), scan(searched=3.01e-3), "not found again within 3.0 mm"),
        ("preload", seen(TARING, preload=0.15), seen(TARING, preload=0.151), "measures 0.15 N before the run"),
        ("preload", seen(preload=0.2), seen(TARING, preload=0.2), "limits.preload_max_n = 0.15"),
        ("joint_speed", seen(), seen(speeding="joint 2 reports a motion"), "joint 2 reports a motion"),
        ("log", seen(), seen(log_failure="bus.log: cannot be written"), "bus.log: cannot be written"),
        ("foreign_master", heard(HEARTBEAT_BASE + 1, 5), heard(SYNC_ID), "another master is on the bus: SYNC"),
        ("nmt_state", heard(HEARTBEAT_BASE + 2, 5), heard(HEARTBEAT_BASE + 2, 4), "2: left operation: NMT state STO"),
        ("emcy", heard(EMCY_BASE + 2, *COMMUNICATION), heard(EMCY_BASE + 2, *TEMPERATURE), "node 2: EMCY 4210h"),
    ],
)
def test_a_limit_itself_is_kept_and_what_is_beyond_is_named(key, within, beyond, told):
    assert check(key)(within) is None
    assert told in str(check(key)(beyond))


def test_what_ends_the_enabling_of_the_drives_already():
    """All that is wrong with nodes, bus, array or log; the rest needs a drive in operation, or a controller."""
    assert {condition.key for condition in CONDITIONS if condition.enabling} == {
        *("foreign_master", "heartbeat", "nmt_state", "emcy", "carrier"),
        *("error_passive", "bus_off", "preload", "joint_speed", "log"),
    }


def test_a_heartbeat_is_lost_after_its_time_and_not_in_it():
    found = seen()
    for node_id in (1, 2):
        found.watch.push(HEARTBEAT_BASE + node_id, bytes((NmtState.OPERATIONAL,)), 1_000_000)
    found.sync_ns = 251_000_000
    assert check("heartbeat")(found) is None
    found.watch.push(HEARTBEAT_BASE + 1, bytes((NmtState.OPERATIONAL,)), 251_000_000)
    found.sync_ns += 1
    assert "node 2: lost: no heartbeat" in str(check("heartbeat")(found))


@pytest.mark.parametrize(("gap_ms", "told"), [(12.5, False), (42.0, True)])
def test_a_drive_that_stopped_because_the_master_was_held_up_says_so(gap_ms, told):
    found = seen(measurement=Measurement(100, 0, enabled=False), gap_ns=round(gap_ms * 1e6))
    first = (0, DriveState.QUICK_STOP_ACTIVE.name)
    found.drives = SimpleNamespace(axes=[SimpleNamespace(node_id=4)], first_not_in=lambda _: first)
    text = str(check("drive_fault")(found))
    assert text.startswith("node 4: (joint 1) left operation enabled: QUICK_STOP_ACTIVE")
    cause = "; the last SYNC was sent 42 ms after the one before, and the drives stop by themselves 12.5 ms after one"
    assert (cause in text) is told
    assert told or text.endswith("QUICK_STOP_ACTIVE")


def test_the_documented_table_is_the_one_that_supervises():
    """Condition, time (of 400 Hz, tactile frames at 200 Hz) and reaction of each row, in the order of precedence."""
    page = (Path(__file__).parents[3] / "docs" / "supervision.md").read_text(encoding="utf-8")
    rows = [
        line.strip("| ").split(" | ") for line in page.partition("| what |")[2].partition("\n\n")[0].splitlines()[2:]
    ]
    documented = [(what, within, does.split(":")[0]) for what, _, within, does, _ in rows]
    assert documented == [
        (c.what, f"{c.within(LIMITS) / 1e6:g} ms" if c.within is not None else "–", c.reaction.value)
        for c in CONDITIONS
    ]


# A saturated array tells only a lower bound: what the supervision makes of it for controllers of the user's own.

PERIOD_NS = 5_000_000


def guarded(patches):
    supervisor, found = Supervisor(seen(), None), []
    for k, patch in enumerate(patches):
        supervisor.seen.patch = patch
        sample = SimpleNamespace(cycle=k, t_sample_ns=k * PERIOD_NS)
        found.append(supervisor.guard_contact(Measurement(2 * k, 0, tactile=sample, tactile_age=2)))
    return found


def shown(force, *, saturated=False, off_pad=False):
    """What an image shows."""
    return felt(force=force, saturated=saturated, off_pad=off_pad, bridged=0.0)


@pytest.mark.parametrize(
    ("patches", "key"),
    [
        ([shown(2.0), *[shown(2.0, saturated=True)] * 6], "force_hidden"),
        ([*[shown(2.0)] * 2, *[shown(2.0, off_pad=True)] * 6], "off_pad"),
    ],
)
def test_an_own_controller_is_guarded_against_a_force_that_shows_in_part(patches, key):
    *before, last = guarded(patches)
    assert before == [None] * len(before)
    assert (last.condition.key, last.condition.reaction) == (key, Reaction.RETREAT)
    assert "the true force is above the 2.0 N measured" in str(last.error)


@pytest.mark.parametrize(
    "patches", [[*[shown(2.0, saturated=True)] * 4, shown(2.0)] * 6, [shown(0.05, off_pad=True)] * 20]
)
def test_a_touch_that_saturates_now_and_then_goes_on_and_so_does_one_without_contact(patches):
    assert guarded(patches) == [None] * len(patches)


def test_a_press_between_two_retreats_is_not_forgotten():
    """4 N for 30 ms, then 4 mm straight back within 200 ms: what the array still shows is its memory, and no press."""
    back = [0.0]

    class Guard:
        measure = staticmethod(lambda _: None)

        def T_base_tip(self, _):
            T = np.eye(4)
            T[2, 3] = -back[0]
            return T

    watched = Supervisor(seen(), Guard())
    for cycle in range(80):
        watched.seen.patch = SimpleNamespace(force=4.0 if 4 <= cycle < 16 else 0.3 * (cycle >= 16))
        back[0] = max(cycle - 16, 0) / 64 * 4e-3
        sample = SimpleNamespace(cycle=cycle, t_sample_ns=0, differs_from=lambda _: True)
        measurement = Measurement(cycle, cycle * 2_500_000, q=np.zeros(6), q_age=(0,) * 6, tactile=sample)
        watched.step(measurement, 0, 0)
        if cycle == 20:
            assert watched.pressing() == 0.3, "not yet clear of it"
    assert watched.pressing() == 0.0
