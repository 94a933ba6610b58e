"""Traffic counted from frames made by hand, against the plan of a scene."""

from __future__ import annotations

import pytest
from scenes import change

import canprobe
from canprobe.cell.planning.measured import TrafficMeter, expected_messages
from canprobe.cell.scene.load import load_scene
from canprobe.fieldbus.protocol.frame_bits import best_case_bits, exact_bits

CYCLES, PERIOD = 400, 2_500_000
US = 1000


@pytest.fixture(scope="module")
def plan():
    return canprobe.plan(load_scene("cylinder"))


def course():
    """One second of the cell as the bus would carry it, with (can_id, data, t_ns) in its order; the plan by hand."""
    for k in range(CYCLES + 1):
        start = k * PERIOD + 65 * US
        counter = k % 240 + 1
        yield 0x080, bytes([counter]), start
        for n in range(1, 7):
            yield 0x180 + n, bytes(8), start + n * 111 * US
        if k % 2 == 0:
            for n in range(9):
                header = bytes([k % 256, counter, 0, 0, 0, 0, 0, 0])
                yield 0x511 + n, header if n == 0 else bytes(8), start + (900 + 100 * n) * US
        for n in range(1, 7):
            yield 0x200 + n, bytes(6), start + (1200 + n * 95) * US
        if k % 40 == 20:
            for node in (1, 2, 3, 4, 5, 6, 16, 127):
                yield 0x700 + node, b"\x05", start + 2350 * US + node


def measure(plan, frames, **options):
    meter = TrafficMeter(plan, **options)
    for frame in frames:
        meter.write(*frame)
    return meter.report()


def by_kind(report):
    return {one.kind: one for one in report.classes}


def test_a_course_as_planned(plan):
    report = measure(plan, course())
    assert report.as_planned
    assert report.duration_s == pytest.approx(1.0)
    counts = {
        kind: (one.frames, round(one.planned_frames, 6)) for kind, one in by_kind(report).items() if one.planned_frames
    }
    assert counts == {
        "SYNC": (400, 400),
        "drive TPDO": (2400, 2400),
        "drive RPDO": (2400, 2400),
        "tactile PDO": (1800, 1800),
        "heartbeat": (80, 80),
    }
    assert [by_kind(report)[kind].frames for kind in ("NMT", "EMCY", "SDO")] == [0, 0, 0]
    assert (report.unlisted, report.missing, report.error_frames) == ({}, (), 0)


def test_bits_are_those_of_the_frames(plan):
    frames = list(course())
    within = frames[: max(i for i, f in enumerate(frames) if f[0] == 0x080)]
    for exact, length in ((True, lambda f: exact_bits(f[0], f[1])), (False, lambda f: best_case_bits(len(f[1])))):
        report = measure(plan, frames, exact=exact)
        assert report.load == pytest.approx(sum(length(f) for f in within) / 1e6, rel=1e-6)
        assert report.load <= report.planned_worst


def test_times_behind_sync_are_shares_of_the_plans_worst_case(plan):
    report = by_kind(measure(plan, course()))
    expected = expected_messages(plan, plan.buses[0])
    shortest = best_case_bits(1) * US
    assert expected[0x186].latest_ns == next(p.response_ns for p in plan.pdos if p.cob_id == 0x186) - shortest
    assert report["drive TPDO"].slowest == pytest.approx(
        max(n * 111 * US / expected[0x180 + n].latest_ns for n in range(1, 7))
    )
    assert report["tactile PDO"].slowest == pytest.approx(
        max((900 + 100 * n) * US / expected[0x511 + n].latest_ns for n in range(9))
    )
    assert not any(one.late for one in report.values())


def test_a_late_frame_is_counted(plan):
    frames = [(c, d, t + (1_200 * US if c == 0x186 and t < 10 * PERIOD else 0)) for c, d, t in course()]
    report = by_kind(measure(plan, frames))["drive TPDO"]
    assert report.late == 10 and report.slowest > 1
    assert report.as_planned, "counts and bits are"


def test_a_tactile_frame_belongs_to_the_sync_that_its_header_names(plan):
    """All nine PDOs two cycles late: behind the next SYNC but one they would look early."""
    late = [(c, d, t + (2 * PERIOD if 0x511 <= c <= 0x519 else 0)) for c, d, t in course()]
    late.sort(key=lambda frame: frame[2])
    report = by_kind(measure(plan, late))["tactile PDO"]
    assert report.late > 1700


@pytest.mark.parametrize("every, planned", [(100, True), (25, False)])
def test_lost_frames(plan, every, planned):
    """1 % of the RPDOs may be missing, 4 % not."""
    frames = [f for f in course() if not (0x201 <= f[0] <= 0x206 and (f[2] // PERIOD) % every == 0)]
    report = measure(plan, frames)
    assert by_kind(report)["drive RPDO"].as_planned is planned
    assert report.missing == ()


def test_a_pdo_that_never_comes_is_named(plan):
    report = measure(plan, [f for f in course() if f[0] != 0x515])
    assert report.missing == (0x515,) and not report.as_planned
    assert "never came: 515h" in report.text()


def test_too_many_frames_are_not_planned(plan):
    doubled = [f for f in course() for _ in range(2 if f[0] == 0x181 else 1)]
    report = measure(plan, doubled)
    assert not by_kind(report)["drive TPDO"].as_planned and not report.as_planned


def test_what_is_sent_on_a_change_may_come_more_often_than_planned_but_not_less():
    plan = canprobe.plan(change(load_scene("free"), arm={"grouped_rpdo": True}))
    for every_ms, planned in ((100, True), (50, True), (200, False)):
        frames = [(0x080, b"\1", k * PERIOD) for k in range(801)]
        frames += [(0x200 + n, bytes(2), k * 1_000_000 + n) for n in range(1, 7) for k in range(1, 2000, every_ms)]
        frames.sort(key=lambda frame: frame[2])
        assert by_kind(measure(plan, frames))["event PDO"].as_planned is planned, every_ms


def test_strangers_are_named_wherever_they_are_in_the_log(plan):
    stranger = (0x333, b"x", 0)
    frames = [stranger, *course(), (0x444, b"", 10**10), stranger]
    report = measure(plan, frames)
    assert report.unlisted == {0x333: 2, 0x444: 1}
    assert not report.as_planned
    assert "not in the plan: 333h, 2 frames" in report.text()
    assert report.as_dict()["unlisted"] == [{"cob_id": 0x333, "frames": 2}, {"cob_id": 0x444, "frames": 1}]


def test_bring_up_and_the_way_out_do_not_count(plan):
    before = [(0x601, bytes(8), 0)] * 50
    after = [(0x000, b"\x80\x01", 10**10)] * 50
    assert by_kind(measure(plan, [*before, *course(), *after]))["SDO"].frames == 0
    assert measure(plan, [*before, *course(), *after]).as_planned


def test_nothing_measured(plan):
    report = measure(plan, [])
    assert report.duration_s == 0 and report.load == 0 and not report.as_planned
    assert report.as_dict()["classes"]["SYNC"]["load"] is None
