"""What the nodes say of themselves, over a night: remembered in bounded memory, and found in bounded time."""

from __future__ import annotations

import pytest

from canprobe.cell.master.watch import NodeWatch
from canprobe.fieldbus.protocol.emcy import Emcy
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, NmtState

SYNC_LOST, OVERHEATED, OVERCURRENT = 0x8100, 0x4210, 0x2310


def told(watch: NodeWatch, node_id: int, code: int) -> None:
    assert watch.push(EMCY_BASE + node_id, Emcy(code, 0, b"\0" * 5).pack(), 0)


def a_watch() -> NodeWatch:
    return NodeWatch((1, 2))


def test_a_device_error_is_found_among_many_about_frames():
    watch = a_watch()
    for _ in range(1000):
        told(watch, 1, SYNC_LOST)
        told(watch, 1, 0)
    assert watch.device_alarm is None
    told(watch, 2, OVERHEATED)
    told(watch, 1, OVERCURRENT)
    assert watch.device_alarm is not None
    assert (watch.device_alarm.node_id, watch.device_alarm.emcy.code) == (2, OVERHEATED)
    assert watch.communication == 1000
    assert watch.last_words(1).startswith("; node 1: EMCY 2310h")
    assert watch.last_words(3) == ""


@pytest.mark.parametrize("code", [0x0100, 0x8000, 0x8311, 0x8611])
def test_an_error_of_the_device(code):
    """Of the same thousand as those about frames 8611h is a following error, 83xxh torque."""
    watch = a_watch()
    told(watch, 2, code)
    assert (len(watch.news()), watch.communication, watch.alarmed) == (1, 0, {2})
    assert watch.device_alarm is not None


@pytest.mark.parametrize(("code", "alarms"), [(0x0000, 0), (0x00FF, 0), (0x8100, 1), (0x82FF, 1)])
def test_an_emcy_that_is_none_of_the_device(code, alarms):
    """Source: CiA 301, emergency error codes: 00xxh is no error, 81xxh and 82xxh are about frames."""
    watch = a_watch()
    told(watch, 2, code)
    assert (len(watch.news()), watch.communication, watch.alarmed) == (alarms, alarms, set())
    assert watch.device_alarm is None


def test_what_a_device_said_before_the_start_is_over():
    watch = a_watch()
    told(watch, 1, OVERHEATED)
    watch.start(0)
    assert watch.device_alarm is None and not watch.alarmed
    assert [event.emcy.code for event in watch.news()] == [OVERHEATED]  # but it is told
    assert watch.news() == []


def state(watch: NodeWatch, node_id: int, code: int, t_ns: int = 0) -> bool:
    return watch.push(HEARTBEAT_BASE + node_id, bytes((code,)), t_ns)


def test_silence_begins_after_250_ms_and_is_counted_from_the_start():
    watch = a_watch()
    assert watch.silent(10**12) is None, "before the start nothing is expected"
    watch.start(1_000_000)
    assert watch.silent(251_000_000) is None
    assert watch.silent(251_000_001) == 1
    state(watch, 1, 5, 200_000_000)
    assert watch.silent(251_000_001) == 2
    state(watch, 2, 5, 201_000_000)
    assert watch.silent(450_000_000) is None and watch.silent(450_000_001) == 1
    assert watch.silent(451_000_000) == 1
    state(watch, 1, 5, 202_000_000)
    assert watch.silent(452_000_000) == 2, "the other one has just its time"
    watch.forget()
    assert watch.silent(10**12) is None and watch.states == {}


def test_a_node_in_another_state_is_named_and_one_that_was_never_heard_is_not():
    watch = a_watch()
    assert watch.not_in(NmtState.OPERATIONAL) is None
    state(watch, 2, 5)
    assert watch.not_in(NmtState.OPERATIONAL) is None
    state(watch, 1, 127)
    assert watch.not_in(NmtState.OPERATIONAL) == 1 and watch.not_in(NmtState.PRE_OPERATIONAL) == 2


def test_boot_ups_are_counted_and_what_is_no_heartbeat_is_not_one():
    watch = a_watch()
    assert state(watch, 1, 0) and state(watch, 1, 127) and state(watch, 1, 0)
    assert watch.boot_ups == {1: 2, 2: 0}
    watch.start(0)
    assert watch.push(HEARTBEAT_BASE + 2, b"", 10**9) and watch.silent(10**9) == 1
    state(watch, 1, 5, 10**9)
    assert watch.silent(10**9) == 2, "an empty frame is no heartbeat"
    assert watch.push(EMCY_BASE + 2, b"\x10", 0) and watch.last_emcy == {}


@pytest.mark.parametrize("can_id", [0x703, 0x083, 0x181, 0x582, 0x7E4])
def test_what_concerns_no_node_of_the_cell_is_left_to_others(can_id):
    watch = a_watch()
    assert not watch.push(can_id, b"\x05", 0)
    assert (watch.states, watch.boot_ups, watch.another_master) == ({}, {1: 0, 2: 0}, None)


@pytest.mark.parametrize(
    ("can_id", "words"),
    [(0x77F, "a heartbeat of node 127, our own id"), (0x080, "SYNC from"), (0x000, "an NMT command from")],
)
def test_another_master_is_named_by_its_first_frame(can_id, words):
    watch = a_watch()
    assert watch.push(can_id, b"\x05\x01", 0)
    for other in (0x77F, 0x080, 0x000):
        assert watch.push(other, b"\x05\x01", 0)
    assert watch.another_master is not None
    assert watch.another_master.startswith(f"another master is on the bus: {words}")


def test_the_end_of_an_error_is_no_alarm_but_the_last_emcy():
    watch = a_watch()
    told(watch, 1, OVERHEATED)
    told(watch, 1, 0)
    assert watch.last_emcy[1].emcy.code == 0 and watch.last_alarm[1].emcy.code == OVERHEATED
    assert str(watch.last_alarm[1]).startswith("node 1: EMCY 4210h, ")
