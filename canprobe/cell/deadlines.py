"""The deadlines behind recorded SYNCs: which multiple of the period each was meant for."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.int64]
_TRIALS = 64
_EARLIER = 8
"""By this part of a period at most the phase may be earlier than the one of the least lateness."""


def find_deadlines(stamps_ns: Numbers, period_ns: int, block: int | None = None) -> tuple[Numbers, Numbers]:
    """The deadline of each SYNC.

    A SYNC goes out at its deadline or less than a period later, and never two for one deadline. The phase of the
    deadlines is the one that obeys this with the least lateness; stamps may be a microsecond early.

    Args:
        stamps_ns: when each SYNC went out (n,), ns, increasing, in whole microseconds as candump has them.
        period_ns: of the cycle.
        block: SYNCs after which the phase is looked for again, where the stamps are another clock's than the
            producer's and drift against it; None where they are the same clock's.

    Returns:
        Number of each deadline (n,), in periods since the first one, strictly increasing; and the deadline itself
        (n,), ns on the clock of the stamps.
    """
    deadlines = np.empty(len(stamps_ns), np.int64)
    numbers = np.empty(len(stamps_ns), np.int64)
    phase: int | None = None
    for first in range(0, len(stamps_ns), block or max(1, len(stamps_ns))):
        part = stamps_ns[first : first + block] if block else stamps_ns
        found = _phase(part, period_ns)
        if phase is not None:  # the same deadlines, drifted: within half a period of the last block's
            found = phase + (found - phase + period_ns // 2) % period_ns - period_ns // 2
        phase = found
        numbers[first : first + len(part)] = (part - phase) // period_ns
        deadlines[first : first + len(part)] = part - (part - phase) % period_ns
    place = np.arange(len(numbers))
    numbers = np.minimum.accumulate((numbers - place)[::-1])[::-1] + place  # of two at one deadline the first is late
    return np.asarray(numbers - numbers[:1], dtype=np.int64), deadlines


def _phase(stamps_ns: Numbers, period_ns: int) -> int:
    """The deadlines' phase, 0 ≤ phase < period: among the stamps' own, so never later than any of them by chance."""
    residues = np.sort(stamps_ns % period_ns)
    candidates, passed = np.unique(residues, return_index=True)
    lateness = period_ns * passed.astype(float) - float(len(residues)) * candidates
    order = np.argsort(lateness, kind="stable")[:_TRIALS]
    trials: list[int] = candidates[order].tolist()
    best = min(trials, key=lambda phase: _implausibility(stamps_ns, phase, period_ns))
    return _earliest(candidates, _doubled(stamps_ns, candidates, period_ns), best, period_ns // _EARLIER)


def _earliest(candidates: Numbers, doubled: Numbers, best: int, most_ns: int) -> int:
    """The earliest phase before ``best`` that contradicts no more than it does.

    Where many SYNCs are late the least lateness is found too late: those that were in time before it would then all be
    a whole period late.
    """
    i = int(np.searchsorted(candidates, best))
    while i > 0 and doubled[i - 1] <= doubled[i] and best - candidates[i - 1] <= most_ns:
        i -= 1
    return int(candidates[i])


def _doubled(stamps_ns: Numbers, phases: Numbers, period_ns: int) -> Numbers:
    """By phase (m,), ascending: how many SYNCs had the deadline of the one before, as none lies between the two."""
    close = np.flatnonzero(np.diff(stamps_ns) < period_ns)
    first = np.searchsorted(phases, stamps_ns[close] % period_ns, side="right")
    end = np.searchsorted(phases, stamps_ns[close + 1] % period_ns, side="right")
    steps = np.zeros(len(phases) + 1, np.int64)
    np.add.at(steps, first, 1)
    np.add.at(steps, end, -1)
    between = np.cumsum(steps)[:-1] + np.count_nonzero(end < first)
    return np.asarray(len(close) - between, dtype=np.int64)


def _implausibility(stamps_ns: Numbers, phase: int, period_ns: int) -> tuple[int, float]:
    """Contradictions of a phase; and the lateness, by its root: many in time and one late, not all a little late.

    Two SYNCs at one deadline contradict it, and so does a first SYNC that is nearly a period late, unless it is: for
    want of one before it nothing else tells an early one from a late one.
    """
    numbers, lateness = np.divmod(stamps_ns - phase, period_ns)
    steps, waits = np.diff(numbers), np.diff(stamps_ns)
    first = bool(len(steps)) and steps[0] > 1 and 2 * waits[0] < 3 * period_ns
    return int(np.count_nonzero(steps < 1)) + int(first), float(np.sqrt(lateness).sum())
