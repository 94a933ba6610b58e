"""Times of each cycle: lateness, response, computing time, and latency of the nodes' answers."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from time import process_time

import numpy as np
from numpy.typing import NDArray

from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.clock import Clock
from canprobe.fieldbus.protocol.frames import SYNC_ID

Times = NDArray[np.int64]


def _nothing() -> Times:
    return np.zeros(0, np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class CycleTimes:
    """Times of the cycles of one run; empty arrays where a time was not measured.

    Attributes:
        period_ns: requested period of SYNC.
        lateness_ns: time of each SYNC behind its deadline (n,), ns.
        seconds: time from the first SYNC to the last.
        response_ns: time from the last TPDO to the RPDOs in every fifth cycle (m,), ns.
        compute_ns: that time and the controller's work after the RPDOs (m,), ns.
        latency_ns: time from each SYNC to the last of the drives' TPDOs that answer it (k,), ns.
        missed: number of TPDOs that did not come in their cycle.
        processor_share: processor time of the master's process over `seconds`; None where it cannot be measured.
    """

    period_ns: int
    lateness_ns: Times
    seconds: float
    response_ns: Times = field(default_factory=_nothing)
    compute_ns: Times = field(default_factory=_nothing)
    latency_ns: Times = field(default_factory=_nothing)
    missed: int = 0
    processor_share: float | None = None

    @property
    def overruns(self) -> int:
        """Number of cycles woken more than half a period late."""
        return int(np.count_nonzero(self.lateness_ns > self.period_ns // 2))

    @property
    def cycles(self) -> int:
        """Number of cycles."""
        return len(self.lateness_ns)

    @property
    def rate_hz(self) -> float:
        """Held rate, cycles per second."""
        return (self.cycles - 1) / self.seconds if self.seconds > 0 else 0.0


def woken(clock: Clock, period_ns: int, cycles: int, lateness: list[int]) -> Iterator[int]:
    """Wake at a number of deadlines, a period apart, and append the lateness of each (ns); missed ones are skipped.

    Yields:
        The deadline, ns, or the last one that has passed by then.
    """
    deadline_ns = clock.now_ns() + period_ns
    for _ in range(cycles):
        clock.sleep_until_ns(deadline_ns)
        lateness.append(clock.now_ns() - deadline_ns)
        deadline_ns += lateness[-1] // period_ns * period_ns
        yield deadline_ns
        deadline_ns += period_ns


def answer_latencies(path: Path, feedback_ids: frozenset[int], period_ns: int) -> Times:
    """Measure the time from each SYNC of a candump log to the last of the TPDOs that answer it within a period.

    Args:
        path: path of the log.
        feedback_ids: COB-IDs of the TPDOs.
        period_ns: period of SYNC.

    Returns:
        One number for each SYNC that all of them answered (k,), ns, in whole microseconds.
    """
    syncs: list[int] = []
    arrivals: dict[int, list[int]] = {can_id: [] for can_id in feedback_ids}
    for t_ns, _, can_id, _ in read_candump(path):
        if can_id == SYNC_ID:
            syncs.append(t_ns)
        elif can_id in arrivals:
            arrivals[can_id].append(t_ns)
    if not syncs or not arrivals:
        return _nothing()
    begins = np.array(sorted(syncs), np.int64)
    last = np.full(len(begins), -1, np.int64)
    complete = np.ones(len(begins), bool)
    for times in arrivals.values():
        stamps = np.array([*sorted(times), np.iinfo(np.int64).max], np.int64)
        delays = stamps[np.searchsorted(stamps, begins)] - begins
        complete &= delays < period_ns
        last = np.maximum(last, delays)
    return last[complete]


def processor_share(used_before_s: float, passed_s: float) -> float | None:
    """Processor share since `process_time` gave `used_before_s`; None in a guest, which counts whole ticks."""
    if os.environ.get("CANPROBE_VCAN") == "guest" or passed_s <= 0:
        return None
    return (process_time() - used_before_s) / passed_s
