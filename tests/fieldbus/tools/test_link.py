"""The link verdict from figures, against what the words mean; and the meter, frame by frame."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

from canprobe.fieldbus import LockstepBus, VirtualClock
from canprobe.fieldbus.bus.joined import JoinedPort
from canprobe.fieldbus.tools.link import AnswerFigures, Fitness, LinkFigures, LinkLimits, LinkMeter, judge_link
from canprobe.fieldbus.tools.link.machine import NOT_AVAILABLE, machine_facts

PERIOD_NS = 2_500_000
WAIT_NS = 1_500_000
LIMITS = LinkLimits(5, 0.1)


def answers(node_id=1, *, number=4000, time_ns=300_000, late=0, absent=0, rows=None):
    times = [time_ns] * (number - late - absent) + [WAIT_NS + 100_000] * late
    rows = (1,) * (late + absent) if rows is None else rows
    return AnswerFigures(node_id, number, tuple(sorted(times)), late, absent, rows)


def figures(*, late=0, nodes=None, number=4000, **more):
    lateness = sorted([10_000] * (number - late) + [PERIOD_NS // 2 + 1] * late)
    return LinkFigures(PERIOD_NS, lateness, WAIT_NS, (answers(), answers(2)) if nodes is None else nodes, **more)


@pytest.mark.parametrize(
    ("late", "fitness"),
    [(0, Fitness.FIT), (4, Fitness.FIT), (5, Fitness.MARGINAL), (80, Fitness.MARGINAL), (81, Fitness.UNFIT)],
)
def test_overruns_up_to_a_thousandth_are_fit_and_above_two_percent_unfit(late, fitness):
    verdict = judge_link(figures(late=late), LIMITS)
    assert verdict.fitness is fitness
    assert verdict.cause == ("" if fitness is Fitness.FIT else "machine")
    assert verdict.overruns[400.0] == late / 4000


def test_the_rate_that_it_is_fit_for_follows_from_the_lateness():
    lateness = sorted([900_000 if i % 20 == 0 else 20_000 for i in range(4000)])
    verdict = judge_link(LinkFigures(PERIOD_NS, lateness, WAIT_NS, (answers(),)), LIMITS)
    assert verdict.fitness is Fitness.FIT and verdict.fit_rate_hz == 500.0  # half of 2 ms is above 0.9 ms
    assert verdict.overruns[1000.0] == pytest.approx(0.05) and verdict.overruns[500.0] == 0.0
    slower = judge_link(figures(late=400), LIMITS)
    assert slower.fit_rate_hz == 333.0 and "--set cycle.rate_hz=333" in slower.way_out


def test_a_lateness_that_outlasts_the_drives_patience_is_unfit_even_if_it_is_rare():
    """Of 4000 SYNCs thirty are late by an exponential time of a mean of two periods: some are beyond four of them."""
    rng = Random(7)
    late = [round(rng.expovariate(0.5) * PERIOD_NS) + PERIOD_NS // 2 for _ in range(30)]
    lateness = sorted([10_000] * 3970 + late)
    assert judge_link(LinkFigures(PERIOD_NS, lateness, WAIT_NS, (answers(),)), LIMITS).fitness is Fitness.UNFIT
    short = sorted([10_000] * 3970 + [PERIOD_NS // 2 + 50_000] * 30)
    assert judge_link(LinkFigures(PERIOD_NS, short, WAIT_NS, (answers(),)), LIMITS).fitness is Fitness.MARGINAL


def woken(rng, period_ns, seconds, kind):
    """Lateness of a loop on a machine whose wake-ups are late one by one, or that stands still for times."""
    lateness, deadline, begin, end = [], period_ns, 0, 0
    while deadline < seconds * 1e9:
        late = 0
        if kind == "single":
            late = rng.expovariate(1 / 3e6) if rng.random() < 0.1 else 0
        else:
            while end < deadline:
                begin = end + rng.expovariate(20e-9)
                end = begin + rng.expovariate(1 / 4e6)
            late = max(0, end - deadline) if begin <= deadline else 0
        lateness.append(late)
        deadline += period_ns * (1 + (late // period_ns if late > period_ns / 2 else 0))
    return sorted(lateness)


@pytest.mark.parametrize("kind", ["single", "still"])
@pytest.mark.parametrize("rate_hz", [100, 1000])
def test_overruns_at_another_rate_follow_from_what_makes_the_machine_late(kind, rate_hz):
    rng = Random(rate_hz)
    slow, fast = woken(rng, PERIOD_NS, 2, kind), woken(rng, 1_000_000, 2, kind)
    measured = figures(nodes=(answers(),), idle_ns=slow, idle_fast_ns=fast)
    measured = replace(measured, lateness_ns=woken(rng, PERIOD_NS, 10, kind))
    seen = share_of(woken(rng, round(1e9 / rate_hz), 60, kind), 1e9 / rate_hz)
    assert judge_link(measured, LIMITS).overruns[rate_hz] == pytest.approx(seen, rel=0.5)


def share_of(lateness, period_ns):
    return sum(late > period_ns / 2 for late in lateness) / len(lateness)


def test_where_the_work_fills_the_period_every_cycle_overruns():
    verdict = judge_link(figures(work_ns=900_000), LIMITS)
    assert verdict.overruns[1000.0] == 1.0 and verdict.overruns[800.0] == 0.0 and verdict.fit_rate_hz == 800.0


@pytest.mark.parametrize("seed", [0, 1, 5])
def test_single_losses_are_marginal_and_rows_that_stop_a_cell_unfit(seed):
    """Losses of a chain with two states, judged from forty seconds, and what an hour of it shows."""
    rng = Random(seed)
    begin, follow = rng.choice([(0.002, 0.05), (0.002, 0.9), (0.3, 0.3), (0.001, 0.2), (0.02, 0.85), (0.05, 0.02)])
    lost, stops, row, seen = False, 0, 0, list[int]()
    for cycle in range(360 * 4000):
        lost = rng.random() < (follow if lost else begin)
        if row and not lost and cycle < 16_000:
            seen.append(row)
        row = row + 1 if lost else 0
        stops += row == LIMITS.missed_cycles + 1
    verdict = judge_link(figures(number=16_000, nodes=(answers(absent=sum(seen), rows=tuple(seen)),)), LIMITS)
    a_minute = stops / 60
    assert verdict.fitness is (Fitness.UNFIT if a_minute > 1 else Fitness.MARGINAL), (begin, follow, a_minute)
    assert verdict.cause == "loss" and verdict.fit_rate_hz is None


@pytest.mark.parametrize(
    ("found", "cause", "words"),
    [
        (figures(nodes=(answers(), answers(2, late=300))), "node", "node 2"),
        (figures(nodes=(answers(late=300), answers(2, late=300))), "jitter", "scattered"),
        (
            figures(nodes=(answers(time_ns=1_300_000, late=9), answers(2, time_ns=1_300_000, late=8))),
            "delay",
            "adapter",
        ),
        (figures(late=100, queue_full=100), "queue", "queue was full 100 times"),
        (figures(nodes=(answers(late=40), answers(2)), foreign_hz=3000.0, load=0.9, planned_load=0.6), "load", "3000"),
        (figures(passive=True, error_frames=12), "controller", "12 bus errors"),
        (figures(failure="can0: interface is down"), "controller", "interface is down"),
    ],
)
def test_a_cause_is_what_stands_out(found, cause, words):
    if cause == "node":
        slow = AnswerFigures(2, 4000, tuple([1_400_000] * 3700 + [1_600_000] * 300), 300, 0, (1,) * 300)
        found = figures(nodes=(answers(), slow))
    verdict = judge_link(found, LIMITS)
    assert verdict.fitness is not Fitness.FIT and verdict.cause == cause and words in verdict.why
    assert verdict.way_out


def test_a_meter_takes_an_answer_for_the_sync_before_it():
    clock = VirtualClock()
    bus = LockstepBus(clock, "can0")
    meter = LinkMeter(bus.port(), wait_ns=WAIT_NS, answers={0x181: 1, 0x281: 1, 0x182: 2}, known={0x701})
    node = bus.port()
    meter.begin()
    plan = [  # time of each answer behind SYNC in µs, of node 1 in two frames
        [(300, 0x181), (400, 0x281), (500, 0x182)],
        [(300, 0x181), (1600, 0x281), (500, 0x182)],
        [(300, 0x181), (500, 0x182), (600, 0x7FF)],
        [(200, 0x701)],
        [],
        [],
    ]
    for cycle, frames in enumerate(plan):
        clock.sleep_until_ns(cycle * PERIOD_NS)
        meter.drain()
        meter.send_batch([(0x080, b"\1")])
        for after_us, can_id in sorted(frames):
            clock.sleep_until_ns(cycle * PERIOD_NS + after_us * 1000)
            node.send_batch([(can_id, bytes(8))])
    meter.end()
    one, two = meter.answers()
    assert (one.expected, one.late, one.absent, one.rows) == (4, 1, 2, (3,))
    assert (two.expected, two.late, two.absent, two.rows) == (4, 0, 1, (1,))
    assert one.times_ns == (400_000, 1_600_000) and meter.foreign == 1
    assert meter.load(1_000_000) == pytest.approx((6 * 55 + 10 * 111) / (meter.seconds * 1e6), rel=0.03)


def test_a_meter_over_several_buses_sends_on_the_named_one_alone():
    """As the requests to an array of raw frames, whose identifiers no route has."""
    clock = VirtualClock()
    buses = {channel: LockstepBus(clock, channel) for channel in ("can0", "can1")}
    others = [bus.port() for bus in buses.values()]
    joined = JoinedPort({channel: bus.port() for channel, bus in buses.items()}, {})
    meter = LinkMeter(joined, wait_ns=WAIT_NS, answers={}, known={})
    meter.begin()
    meter.send_on("can1", [(0x101, b"\1")])
    assert [port.drain() for port in others] == [[], [(0x101, b"\1", 0)]]
    assert meter.bits > 0


def test_what_a_machine_does_not_say_is_not_available():
    facts = machine_facts("nosuch0")
    assert facts["driver"] == facts["transmit_queue"] == NOT_AVAILABLE
    assert facts["kernel"] and facts["realtime_priority"]
