"""Overruns to expect at another rate than that of the measurement. Pure.

A SYNC is late for one of two reasons, which the figures of one rate cannot tell apart:

- *single wake-ups* are late, each with the same chance (timers, sleep states of the processor): the same share of the
  SYNCs is later than half of another period;
- *the machine stands still* for a time (another process, a virtual machine that is not served): a standstill makes one
  SYNC late, however many periods it covers, so that their number a second is nearly the same at each rate.

At 400 Hz and 1000 Hz the two differ by 2.5. Two loops that do nothing say which it is, one of the same period and one
of 1000 Hz: that by which the late wake-ups of the first predict those of the second better. Where the work of a usual
cycle is longer than a period, every cycle overruns.

Both stop being true where most cycles are late, and see nothing of the work of a controller.
"""

from __future__ import annotations

from collections.abc import Sequence

from canprobe.fieldbus.tools.link.figures import IDLE_FAST_NS, LinkFigures, late_share


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
