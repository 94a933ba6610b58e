"""From the figures of a link to a verdict: fit, marginal or unfit for a rate, why, and what to type. Pure.

Overruns: the share of SYNCs that were later than half a period. What that is at other rates follows from the same
lateness. A SYNC is late for one of two reasons, which the figures of one rate cannot tell apart:

- *single wake-ups* are late, each with the same chance (timers, sleep states of the processor): the same share of the
  SYNCs is later than half of another period;
- *the machine stands still* for a time (another process, a virtual machine that is not served): a standstill makes one
  SYNC late, however many periods it covers, so that their number a second is nearly the same at each rate.

At 400 Hz and 1000 Hz the two differ by 2.5. Two loops that do nothing say which it is, one of the same period and one
of 1000 Hz: that by which the late wake-ups of the first predict those of the second better. Where the work of a usual
cycle is longer than a period, every cycle overruns. Both stop being true where most cycles are late, and see nothing
of the work of a controller.

A SYNC that is later than the drives wait stops the cell: how many a minute has follows from the late ones, whose tail
is taken for exponential.

Answers: one that is missed makes a link marginal. A node whose answers fail in rows of k cycles stops the cell. How
many rows a minute has follows from those that were seen: with N_j rows of at least j cycles, a row of j goes on with
probability (N_{j+1} + ¼) / (N_j + ½), as a survival is estimated (Kaplan and Meier 1958). Nothing was missed, but the
slowest answers end close to the time until which the cell waits: their tail is taken for exponential, and a minute is
longer than the measurement.

A cause is the symptom that stands out: a full queue, frames of others, one node that differs, answers that come but
late (all by the same time: the adapter's delay; scattered: jitter), answers that never come, late SYNCs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from canprobe.fieldbus.tools.link.figures import IDLE_FAST_NS, LinkFigures, late_share, quantile

MINUTE_S = 60.0
FIT_SHARE, UNFIT_SHARE = 0.001, 0.02
"""Shares of overruns up to which a link is fit, and above which it is unfit."""
STOPS_EXPECTED = 0.7
"""Rows of missed answers that stop the cell, in a minute, from which one is more likely than none."""
MORE_LOAD = 0.05
"""Load above the plan's at which others are the cause."""
RATES_HZ = (1000.0, 800.0, 500.0, 400.0, 333.0, 250.0, 200.0, 125.0, 100.0, 50.0, 20.0)
NODE_APART = 0.2
"""Distance of its usual answer from the next slowest, a share of the wait: nodes answer one behind the other."""
MIN_TAIL = 5
"""Fewest times of a tail from which a longer one is estimated."""
ONE_NODE_SHARE = 0.9
"""Share of all missed answers that one node has where it is the cause."""


class Fitness(StrEnum):
    """Verdict on a link."""

    FIT = "fit"
    MARGINAL = "marginal"
    UNFIT = "unfit"


_ORDER = (Fitness.FIT, Fitness.MARGINAL, Fitness.UNFIT)


@dataclass(frozen=True, slots=True)
class LinkLimits:
    """Limits of the cell that the link is judged for.

    Attributes:
        missed_cycles: cycles without an answer after which the cell stops.
        late_share: share of a second's cycles that may be late before the cell stops.
    """

    missed_cycles: int = 5
    late_share: float = 0.1


@dataclass(frozen=True, slots=True)
class LinkVerdict:
    """The verdict.

    Attributes:
        fitness: fit, marginal or unfit for the rate.
        rate_hz: the rate of the cycle.
        cause: key of the cause: machine, delay, jitter, loss, load, node, queue, controller; empty of a fit link.
        why: the cause in words, with its figures.
        way_out: what to do about it, with the line to type.
        fit_rate_hz: highest rate that it would be fit for; None where no rate is.
        overruns: predicted share of overruns, by rate, Hz.
    """

    fitness: Fitness
    rate_hz: float
    cause: str = ""
    why: str = ""
    way_out: str = ""
    fit_rate_hz: float | None = None
    overruns: dict[float, float] = field(default_factory=dict)

    def as_document(self) -> dict[str, Any]:
        """The verdict for JSON."""
        return {
            "verdict": str(self.fitness),
            "rate_hz": self.rate_hz,
            **{name: getattr(self, name) or None for name in ("cause", "why", "way_out")},
            "fit_rate_hz": self.fit_rate_hz,
            "overruns_percent": {f"{rate:g}": 100.0 * share for rate, share in self.overruns.items()},
        }


def judge_link(figures: LinkFigures, limits: LinkLimits) -> LinkVerdict:
    """Judge a link for the rate at which it was measured.

    Args:
        figures: at least a second of them.
        limits: limits of the cell.
    """
    rate_hz = 1e9 / figures.period_ns
    findings = [
        (answers := _answers(figures, limits, figures.wait_ns)),
        (lateness := _lateness(figures, limits, figures.period_ns)),
        Fitness.UNFIT if figures.failure is not None or figures.passive or figures.array_silent else Fitness.FIT,
        Fitness.MARGINAL if figures.torn or figures.dropped else Fitness.FIT,
    ]
    worst = max(findings, key=_ORDER.index)
    overruns = {rate: predict_overruns(figures, rate) for rate in sorted({*RATES_HZ, rate_hz}) if rate >= 100.0}
    fit_rate = _fit_rate(figures, limits, rate_hz)
    if worst is Fitness.FIT:
        return LinkVerdict(worst, rate_hz, fit_rate_hz=fit_rate, overruns=overruns)
    late = _ORDER.index(lateness) >= _ORDER.index(answers) and lateness is not Fitness.FIT
    cause, why, way_out = _cause(figures, late=late)
    if fit_rate is not None and fit_rate < rate_hz:
        way_out += f"; or a lower rate: --set cycle.rate_hz={fit_rate:g}"
    return LinkVerdict(worst, rate_hz, cause, why, way_out, fit_rate, overruns)


def predict_overruns(figures: LinkFigures, rate_hz: float) -> float:
    """Share of the cycles that overrun at a rate, Hz.

    Args:
        figures: figures that were measured at their own rate.
        rate_hz: the rate.
    """
    period_ns = round(1e9 / rate_hz)
    if period_ns == figures.period_ns:
        return figures.late_share()
    if figures.usual_ns > period_ns:
        return 1.0
    if _stands_still(figures):
        return standstill_share(figures.lateness_ns, figures.period_ns, period_ns)
    return late_share(figures.lateness_ns, period_ns)


def standstill_share(lateness_ns: Sequence[int], period_ns: int, other_ns: int) -> float:
    """Share of the cycles of another period that overrun by standstills.

    A SYNC that is late by L was caught by a standstill that began half a period before its deadline on average, or, if
    that is shorter, as long before it as it went on: it lasts D = L + T/2, or 2 L. It is seen with probability D/T, or
    surely, and makes a SYNC of period T' overrun with probability (D - T'/2) / T', or surely.

    Args:
        lateness_ns: lateness of each SYNC, ns.
        period_ns: period T at which they were seen, ns.
        other_ns: the other period T', ns.
    """
    overruns = 0.0
    for late in lateness_ns:
        lasts = late + min(late, period_ns / 2)
        if lasts > other_ns / 2:
            overruns += min(1.0, (lasts - other_ns / 2) / other_ns) / min(1.0, lasts / period_ns)
    return min(1.0, overruns * other_ns / (period_ns * max(1, len(lateness_ns))))


def _stands_still(figures: LinkFigures) -> bool:
    """Whether standstills predict the faster idle loop better than single wake-ups."""
    slow, fast = figures.idle_ns, late_share(figures.idle_fast_ns, IDLE_FAST_NS)
    single = late_share(slow, IDLE_FAST_NS)
    return abs(standstill_share(slow, figures.period_ns, IDLE_FAST_NS) - fast) < abs(single - fast)


def _lateness(figures: LinkFigures, limits: LinkLimits, period_ns: int) -> Fitness:
    share = predict_overruns(figures, 1e9 / period_ns)
    if share > min(UNFIT_SHARE, limits.late_share) or _gaps_expected(figures, limits, period_ns) > STOPS_EXPECTED:
        return Fitness.UNFIT
    return Fitness.MARGINAL if share > FIT_SHARE else Fitness.FIT


def _gaps_expected(figures: LinkFigures, limits: LinkLimits, period_ns: int) -> float:
    """Number of SYNCs a minute so late that the drives take their master for dead, by an exponential tail of the late
    ones: they stop `missed_cycles` periods after the SYNC before.
    """
    limit_ns, most_ns = period_ns // 2, (limits.missed_cycles - 1) * period_ns
    late = [time - limit_ns for time in figures.lateness_ns if time > limit_ns]
    if len(late) < MIN_TAIL:
        return float(sum(time > most_ns for time in figures.lateness_ns))
    return len(late) / figures.seconds * MINUTE_S * math.exp((limit_ns - most_ns) * len(late) / sum(late))


def _answers(figures: LinkFigures, limits: LinkLimits, wait_ns: int) -> Fitness:
    """Fitness by the answers, for a cell that waits for them until `wait_ns`."""
    stops, missed, tail_ns = 0.0, 0, 0.0
    for one in figures.answers:
        missed += sum(time > wait_ns for time in one.times_ns) + one.absent
        stops += _rows_expected(one.rows, limits.missed_cycles + 1) / figures.seconds * MINUTE_S
        tail_ns = max(tail_ns, _longest_in_a_minute(one.times_ns, figures.seconds))
    if stops > STOPS_EXPECTED:
        return Fitness.UNFIT
    return Fitness.MARGINAL if missed or tail_ns > wait_ns else Fitness.FIT


def _rows_expected(rows: Sequence[int], cycles: int) -> float:
    """Number of rows of at least so many cycles to expect in a time like the measured one."""
    expected, reached, goes_on = float(len(rows)), len(rows), 1.0
    for length in range(1, cycles):
        longer = sum(row > length for row in rows)
        goes_on = (longer + 0.25) / (reached + 0.5) if reached else goes_on  # beyond the longest as at its end
        expected *= goes_on
        reached = longer
    return max(expected, float(reached)) if rows else 0.0


def _longest_in_a_minute(ascending: Sequence[int], seconds: float) -> float:
    """Longest time to expect in a minute, ns: by an exponential tail behind the 99th percentile, or by its last steps.

    On a full bus answers have a bound: the longest lies close to the 99.9th percentile, and no longer ones follow.
    """
    beyond = ascending[int(0.99 * len(ascending)) :]
    if len(beyond) < MIN_TAIL:
        return float(beyond[-1] if beyond else 0)
    mean_excess = sum(beyond) / len(beyond) - beyond[0]
    number = len(beyond) * max(1.0, MINUTE_S / seconds)
    longest, last_steps = beyond[-1], beyond[-1] - beyond[int(0.9 * len(beyond))]
    more = math.log(max(1.0, MINUTE_S / seconds)) / math.log(10.0) * last_steps
    return min(longest + 2.0 * more, max(float(longest), beyond[0] + mean_excess * math.log(number)))


def _fit_rate(figures: LinkFigures, limits: LinkLimits, rate_hz: float) -> float | None:
    """Highest rate at which the same answers and lateness would be fit; None where none is."""
    if figures.failure is not None or figures.passive or figures.array_silent:
        return None
    if any(one.absent for one in figures.answers):
        return None
    load, planned = figures.load or 0.0, figures.planned_load or 0.0
    for rate in sorted({*RATES_HZ, rate_hz}, reverse=True):
        period_ns = round(1e9 / rate)
        wait_ns = round(figures.wait_ns * period_ns / figures.period_ns)
        full = max(load, planned) * rate / rate_hz > 1.0
        sound = _lateness(figures, limits, period_ns) is Fitness.FIT
        if not full and sound and _answers(figures, limits, wait_ns) is Fitness.FIT:
            return rate
    return None


def _cause(figures: LinkFigures, *, late: bool) -> tuple[str, str, str]:
    """Key of the cause, the cause in words, and what to do."""
    if figures.failure is not None and not figures.queue_full:
        return "controller", figures.failure, "see to the interface first"
    if figures.passive:
        why = f"the CAN controller is error-passive or bus-off, after {figures.error_frames} bus errors"
        return "controller", why, "check power of the nodes, bit rate, wiring and termination (60 ohm)"
    if figures.queue_full:
        why = f"the transmit queue was full {figures.queue_full} times"
        return "queue", why, "type: sudo ip link set CHANNEL txqueuelen 1000"
    more = (figures.load or 0.0) - (figures.planned_load or 0.0)
    if figures.foreign_hz * figures.period_ns * 1e-9 > 0.5 and (not late or more > MORE_LOAD):
        why = (
            f"others send {figures.foreign_hz:.0f} frames/s that are not of the plan; the load is"
            f" {100 * (figures.load or 0.0):.0f} %"
        )
        return "load", why, "type: candump CHANNEL, and stop them or give them another bus"
    if late:
        p99, most = quantile(figures.lateness_ns, 0.99) or 0, quantile(figures.lateness_ns, 1.0) or 0
        why = (
            f"{100 * figures.late_share():.2f} % of the SYNCs come more than half a period late: p99"
            f" {p99 * 1e-3:.0f} µs, at most {most * 1e-3:.0f} µs"
        )
        return "machine", why, "type: canprobe … --realtime, as root or after: ulimit -r 50; end other work"
    return _cause_of_answers(figures)


def _cause_of_answers(figures: LinkFigures) -> tuple[str, str, str]:
    answers = figures.answers
    missed = sum(one.missed for one in answers)
    worst = max(answers, key=lambda one: (one.missed, one.at(1.0) or 0), default=None)
    if worst is None or (not missed and (figures.torn or figures.array_silent)):
        if figures.array_silent:
            return "loss", "the array sends no images", "check its power, its cable, and that SYNC reaches it"
        why = f"{figures.torn} images of the array did not come, or not whole"
        return "loss", why, "check cable, terminators and its load"
    others = [time for one in answers if one is not worst and (time := one.at(0.5)) is not None]
    usual = max(others, default=None)
    alone = usual is not None and (worst.missed > ONE_NODE_SHARE * missed if missed else True)
    median, least, most = worst.at(0.5) or 0, worst.at(0.0) or 0, worst.at(1.0) or 0
    if missed and sum(one.absent for one in answers) > missed / 2:
        where = f"of node {worst.node_id}" if alone and len(answers) > 1 else f"in all, most of node {worst.node_id}"
        expected = sum(one.expected for one in answers)
        why = f"{missed} of {expected} answers did not come, {worst.missed} {where}"
        return "loss", why, "check cable, terminators and sample point; sudo ip -s link show CHANNEL counts errors"
    if alone and usual is not None and median - usual > NODE_APART * figures.wait_ns:
        why = (
            f"node {worst.node_id} answers {median * 1e-3:.0f} µs behind SYNC, at most {most * 1e-3:.0f} µs; the"
            f" slowest of the others {usual * 1e-3:.0f} µs; the cell waits {figures.wait_ns * 1e-3:.0f} µs"
        )
        return "node", why, f"look for a filter, an inhibit time (1800h:03) or a slow firmware of node {worst.node_id}"
    spread = f"{least * 1e-3:.0f} to {most * 1e-3:.0f} µs, half of them below {median * 1e-3:.0f} µs"
    why = f"answers come {spread}; the cell waits {figures.wait_ns * 1e-3:.0f} µs"
    if median - least > most - median or least > 0.5 * figures.wait_ns:
        return "delay", f"all {why}: the adapter or its driver delays them", "take an adapter with less latency"
    return "jitter", f"scattered {why}", "take an adapter with less jitter, another USB port, or --realtime"
