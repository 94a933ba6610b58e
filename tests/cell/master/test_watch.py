"""What the nodes say of themselves, over a night: remembered in bounded memory, and found in bounded time."""

from __future__ import annotations

import sys

import pytest

from canprobe.cell.master.watch import MAX_NEW_ALARMS, NodeWatch
from canprobe.fieldbus.protocol.emcy import Emcy
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE

SYNC_LOST, OVERHEATED, OVERCURRENT = 0x8100, 0x4210, 0x2310


def told(watch: NodeWatch, node_id: int, code: int) -> None:
    assert watch.push(EMCY_BASE + node_id, Emcy(code, 0, b"\0" * 5).pack(), 0)


def a_watch() -> NodeWatch:
    return NodeWatch((1, 2))


def size_of(watch: NodeWatch) -> int:
    return sum(sys.getsizeof(value) for value in vars(watch).values())


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


@pytest.mark.parametrize(
    ("code", "of_frames"),
    [(0x8100, True), (0x8110, True), (0x81FF, True), (0x8250, True), (0x8000, False), (0x8311, False), (0x8611, False)],
)
def test_following_errors_and_the_like_are_about_the_device(code, of_frames):
    """81xxh and 82xxh are about frames; of the same thousand 8611h is a following error, 83xxh torque."""
    watch = a_watch()
    told(watch, 2, code)
    assert (watch.communication, watch.device_alarm is None, watch.alarmed) == (
        (1, True, set()) if of_frames else (0, False, {2})
    )


def test_what_a_device_said_before_the_start_is_over():
    watch = a_watch()
    told(watch, 1, OVERHEATED)
    watch.start(0)
    assert watch.device_alarm is None and not watch.alarmed
    assert [event.emcy.code for event in watch.news()] == [OVERHEATED]  # but it is told
    assert watch.news() == []


@pytest.mark.parametrize(("code", "alarms"), [(0x0000, 0), (0x00FF, 0), (0x0100, 1), (0x0856, 1)])
def test_only_00xxh_is_no_error(code, alarms):
    """Source: CiA 301, emergency error codes."""
    watch = a_watch()
    told(watch, 1, code)
    assert len(watch.news()) == alarms
    assert (watch.device_alarm is not None) == bool(alarms)


def test_memory_does_not_grow_with_what_is_said():
    watch = a_watch()
    for _ in range(MAX_NEW_ALARMS):
        told(watch, 1, SYNC_LOST)
        watch.push(0x80, b"", 0)
    before = size_of(watch)
    for _ in range(10_000):
        told(watch, 1, SYNC_LOST)
        watch.push(0x80, b"", 0)
        watch.push(HEARTBEAT_BASE + 1, b"\x05", 0)
    assert size_of(watch) <= before + 1000  # numbers have grown by a digit, a table by its first entry
    assert len(watch.news()) == MAX_NEW_ALARMS
    assert watch.foreign == "SYNC from another master"
