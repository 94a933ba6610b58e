"""Each check of the table of conditions at its limit and just beyond it: the runs that inject faults go far beyond."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from canprobe.bus.port import ControllerState, PortCounters
from canprobe.cell import checks
from canprobe.cell.measurement import Measurement
from canprobe.cell.supervision import Contact, Limits, Seen
from canprobe.cell.watch import NodeWatch
from canprobe.protocol.cia402 import DriveState
from canprobe.protocol.frames import HEARTBEAT_BASE, NmtState

LIMITS = Limits(
    period_ns=2_500_000,
    hold_cycles=3,
    missed_cycles=5,
    heartbeat_timeout_ns=250_000_000,
    tactile_timeout=12,
    lost_ns=30_000_000,
    force_max=5.0,
    late_share=0.8,
    hold_ns=1_000_000_000,
)
PASSIVE = {"controller_state": ControllerState.PASSIVE}


def seen(**fields):
    return Seen(LIMITS, NodeWatch((1, 2), 127, LIMITS.heartbeat_timeout_ns), None, None, PortCounters(), **fields)


def with_ages(*ages):
    """Two drives that were heard last so many cycles ago."""
    found = seen(measurement=Measurement(100, 0, q_age=ages))
    found.drives = SimpleNamespace(axes=[SimpleNamespace(node_id=1), SimpleNamespace(node_id=2)])
    return found


def touch(force=2.0, age=2, lost_s=0.0):
    return Contact(LIMITS, force, age, lost_s)


@pytest.mark.parametrize(
    ("check", "within", "beyond", "told"),
    [
        (checks.force, touch(5.0), touch(5.001), "5.00 N above the limit of 5.00 N"),
        (checks.sensor_stale, touch(age=12), touch(age=13), "no tactile frame for 13 cycles"),
        (checks.contact_lost, touch(lost_s=0.0299), touch(lost_s=0.0301), "contact lost"),
        (checks.drive_late, with_ages(0, 2), with_ages(0, 3), "node 2: no usable TPDO for 3 cycles"),
        (checks.drive_silent, with_ages(5, 0), with_ages(6, 0), "node 1: lost: no usable TPDO for 6 cycles"),
        (checks.overruns, seen(late_share=0.8), seen(late_share=0.81), "81 % of the last second's cycles"),
        (
            checks.held_too_long,
            seen(passive_ns=1_000_000_000, **PASSIVE),
            seen(passive_ns=1_002_500_000, **PASSIVE),
            "error-passive for 1.0 s",
        ),
        (checks.error_passive, seen(), seen(passive_ns=1_000_000_000, **PASSIVE), "error-passive"),
        (checks.bus_off, seen(**PASSIVE), seen(controller_state=ControllerState.BUS_OFF), "bus-off"),
    ],
)
def test_a_limit_itself_is_kept_and_what_is_beyond_is_named(check, within, beyond, told):
    assert check(within) is None
    assert told in str(check(beyond))


def test_a_hold_that_took_too_long_is_a_retreat_and_no_longer_a_hold():
    assert checks.error_passive(seen(passive_ns=1_000_000_001, **PASSIVE)) is None


def test_a_heartbeat_is_lost_after_its_time_and_not_in_it():
    found = seen()
    for node_id in (1, 2):
        found.watch.push(HEARTBEAT_BASE + node_id, bytes((NmtState.OPERATIONAL,)), 1_000_000)
    found.sync_ns = 251_000_000
    assert checks.heartbeat_lost(found) is None
    found.watch.push(HEARTBEAT_BASE + 1, bytes((NmtState.OPERATIONAL,)), 251_000_000)
    found.sync_ns += 1
    assert "node 2: lost: no heartbeat" in str(checks.heartbeat_lost(found))


@pytest.mark.parametrize(("gap_ms", "told"), [(12.5, False), (42.0, True)])
def test_a_drive_that_stopped_because_the_master_was_held_up_says_so(gap_ms, told):
    found = seen(measurement=Measurement(100, 0, enabled=False), gap_ns=round(gap_ms * 1e6))
    first = (0, DriveState.QUICK_STOP_ACTIVE.name)
    found.drives = SimpleNamespace(axes=[SimpleNamespace(node_id=4)], first_not_in=lambda _: first)
    text = str(checks.drive_not_enabled(found))
    assert text.startswith("node 4: (joint 1) left operation enabled: QUICK_STOP_ACTIVE")
    cause = "; the last SYNC was sent 42 ms after the one before, and the drives stop by themselves 12.5 ms after one"
    assert (cause in text) is told
    assert told or text.endswith("QUICK_STOP_ACTIVE")
