"""What a cycle on a real interface took: lateness of SYNC, computing time, and how late the last TPDO was in."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from canprobe.bus.candump import read_candump
from canprobe.bus.clock import Clock
from canprobe.protocol.frames import SYNC_ID

Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class CycleTimes:
    """One run.

    Attributes:
        period_ns: of SYNC, as asked.
        lateness_ns: of each SYNC behind its deadline (n,), ns.
        response_ns: from the last TPDO to the RPDOs, of every fifth cycle (m,), ns.
        compute_ns: the same with the controller's work once the RPDOs are out (m,), ns.
        latency_ns: from each SYNC to the last of the drives' TPDOs that answer it (k,), ns.
        overruns: cycles woken more than half a period late.
        missed: TPDOs that a cycle did without.
        seconds: from the first SYNC to the last.
        processor_share: processor time of the master's process over `seconds`; None where it cannot be measured.
    """

    period_ns: int
    lateness_ns: Times
    response_ns: Times
    compute_ns: Times
    latency_ns: Times
    overruns: int
    missed: int
    seconds: float
    processor_share: float | None

    @classmethod
    def of_wakes(
        cls,
        period_ns: int,
        lateness: Sequence[int],
        seconds: float,
        *,
        missed: int = 0,
        processor_share: float | None = None,
    ) -> CycleTimes:
        """Of a loop of which no more is known than how late it woke each time, ns."""
        nothing = np.zeros(0, np.int64)
        return cls(
            period_ns=period_ns,
            lateness_ns=np.array(lateness, np.int64),
            response_ns=nothing,
            compute_ns=nothing,
            latency_ns=nothing,
            overruns=sum(late > period_ns // 2 for late in lateness),
            missed=missed,
            seconds=seconds,
            processor_share=processor_share,
        )

    @property
    def cycles(self) -> int:
        """Cycles that were begun."""
        return len(self.lateness_ns)

    @property
    def rate_hz(self) -> float:
        """Cycles a second, as held."""
        return (self.cycles - 1) / self.seconds if self.seconds > 0 else 0.0


def woken(clock: Clock, period_ns: int, cycles: int, lateness: list[int]) -> Iterator[int]:
    """Wake at so many deadlines, a period apart, and add how late each was (ns); missed ones are passed over.

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
    """From each SYNC of a candump log to the last of the TPDOs that answer it within a period.

    Args:
        path: of the log.
        feedback_ids: COB-IDs of the TPDOs.
        period_ns: of SYNC.

    Returns:
        One number for each SYNC that all of them answered (k,), ns, to the log's microsecond.
    """
    syncs: list[int] = []
    arrivals: dict[int, list[int]] = {can_id: [] for can_id in feedback_ids}
    for t_ns, _, can_id, _ in read_candump(path):
        if can_id == SYNC_ID:
            syncs.append(t_ns)
        elif can_id in arrivals:
            arrivals[can_id].append(t_ns)
    if not syncs or not arrivals:
        return np.zeros(0, np.int64)
    begins = np.array(sorted(syncs), np.int64)
    last = np.full(len(begins), -1, np.int64)
    complete = np.ones(len(begins), bool)
    for times in arrivals.values():
        stamps = np.array([*sorted(times), np.iinfo(np.int64).max], np.int64)
        delays = stamps[np.searchsorted(stamps, begins)] - begins
        complete &= delays < period_ns
        last = np.maximum(last, delays)
    return last[complete]


def processor_seconds() -> float:
    """Processor time of this process so far, s."""
    times = os.times()
    return times.user + times.system


def share_of(used_before_s: float, passed_s: float) -> float | None:
    """Processor share since `processor_seconds` gave `used_before_s`; None in a guest, which counts whole ticks."""
    if os.environ.get("CANPROBE_VCAN") == "guest" or passed_s <= 0:
        return None
    return (processor_seconds() - used_before_s) / passed_s
