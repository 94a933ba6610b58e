"""A saturated array tells only a lower bound: what the supervision makes of it for controllers of the user's own."""

from types import SimpleNamespace

import pytest

from canprobe.bus.port import PortCounters
from canprobe.cell.hidden_force import HiddenForce
from canprobe.cell.measurement import Measurement
from canprobe.cell.supervision import Limits, Reaction, Seen
from canprobe.cell.supervisor import Supervisor
from canprobe.cell.watch import NodeWatch

PERIOD_NS = 5_000_000


def test_only_an_unbroken_run_of_saturated_samples_counts():
    hidden = HiddenForce()
    told = []
    for k, saturated in enumerate((True, True, True, False, True, True)):
        hidden.add(saturated, k * PERIOD_NS)
        told.append(hidden.hidden_s)
    assert told == pytest.approx([0.0, 0.005, 0.01, 0.0, 0.0, 0.005])


def supervisor(patches):
    seen = Seen(Limits(2_500_000), NodeWatch((), 127, 250_000_000), None, None, PortCounters())
    return Supervisor(seen, lambda sample: patches[sample.cycle])


def findings(saturated):
    patches = [SimpleNamespace(force=2.0, saturated=one, off_pad=False) for one in saturated]
    return guarded(patches)


def guarded(patches):
    guard = supervisor(patches)
    samples = [SimpleNamespace(cycle=k, t_sample_ns=k * PERIOD_NS) for k in range(len(patches))]
    return [guard.guard_contact(Measurement(2 * k, 0, tactile=s, tactile_age=2)) for k, s in enumerate(samples)]


def test_an_own_controller_is_guarded_against_it():
    found = findings([False, True, True, True, True, True, True])
    assert found[:6] == [None] * 6
    assert found[6].condition.key == "force_hidden"
    assert found[6].condition.reaction is Reaction.RETREAT
    assert "above the 2.0 N measured" in str(found[6].error)


def test_a_touch_that_saturates_now_and_then_goes_on():
    assert findings([True, True, True, True, False] * 6) == [None] * 30


def test_nor_may_its_contact_run_off_the_array():
    running_off = [SimpleNamespace(force=1.0, saturated=False, off_pad=k > 1) for k in range(8)]
    found = guarded(running_off)
    assert found[:7] == [None] * 7
    assert found[7].condition.key == "off_pad" and found[7].condition.reaction is Reaction.RETREAT
    assert "the true force is above the 1.0 N measured" in str(found[7].error)
    assert guarded([SimpleNamespace(force=0.05, saturated=False, off_pad=True)] * 20) == [None] * 20, (
        "no contact at all"
    )
