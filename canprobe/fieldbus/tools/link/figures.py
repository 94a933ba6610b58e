"""What was measured of a link: lateness of SYNC, answers of each node, load, queues."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class AnswerFigures:
    """The answers of one node to SYNC.

    Attributes:
        node_id: the node.
        expected: number of answers that were due.
        times_ns: times of all answers behind their SYNC, ascending, ns; late ones too.
        late: answers that came after the cell stops waiting for them.
        absent: answers that did not come before the next SYNC.
        rows: length of each unbroken row of cycles without an answer in time.
    """

    node_id: int
    expected: int
    times_ns: tuple[int, ...]
    late: int
    absent: int
    rows: tuple[int, ...]

    @property
    def missed(self) -> int:
        """Answers that the cell could not use in their cycle."""
        return self.late + self.absent

    def at(self, share: float) -> int | None:
        """Quantile of the times, ns; None without an answer."""
        return quantile(self.times_ns, share)

    def as_document(self) -> dict[str, Any]:
        """The figures for JSON."""
        times = {name: us(self.at(share)) for name, share in QUANTILES.items()}
        counts = {name: getattr(self, name) for name in ("expected", "late", "absent")}
        longest = max(self.rows, default=0)
        return {"node_id": self.node_id, **counts, "longest_row": longest, "answer_us": times}


@dataclass(frozen=True, slots=True)
class LinkFigures:
    """The figures of a link over some cycles.

    Attributes:
        period_ns: period of SYNC.
        lateness_ns: delay of each SYNC behind its deadline, ascending, ns.
        wait_ns: time after SYNC until which the cell waits for answers.
        answers: the answers of the nodes that the cell waits for.
        torn: images of the array that did not come, or not whole; None without an array.
        array_silent: whether the array sent no images at the end.
        load, planned_load: share of the bit rate that was measured, and the worst case of the plan; None: not known.
        foreign_hz: frames a second that the plan does not know.
        queue_full: number of times that the transmit queue was full.
        dropped: frames that were lost on this machine.
        error_frames: number of bus errors.
        passive: whether the CAN controller was error-passive or bus-off at the end.
        failure: error of the interface that ended the measurement; None where it went to its end.
        work_ns: usual time from the last answer to the end of the commands, ns.
        idle_ns: lateness of a loop of the same period that does nothing, ascending, ns; empty: not measured.
        idle_fast_ns: lateness of one of `IDLE_FAST_NS`.
    """

    period_ns: int
    lateness_ns: Sequence[int]
    wait_ns: int
    answers: tuple[AnswerFigures, ...] = ()
    torn: int | None = None
    array_silent: bool = False
    load: float | None = None
    planned_load: float | None = None
    foreign_hz: float = 0.0
    queue_full: int = 0
    dropped: int = 0
    error_frames: int = 0
    passive: bool = False
    failure: str | None = None
    work_ns: int = 0
    idle_ns: Sequence[int] = ()
    idle_fast_ns: Sequence[int] = ()

    @property
    def cycles(self) -> int:
        """Number of cycles."""
        return len(self.lateness_ns)

    @property
    def seconds(self) -> float:
        """Length of the measurement, s."""
        return self.cycles * self.period_ns * 1e-9

    @property
    def usual_ns(self) -> int:
        """Time that the work of a usual cycle takes, ns: to the answer of the slowest node, and to the commands."""
        return max((one.at(0.5) or 0 for one in self.answers), default=0) + self.work_ns

    def late_share(self) -> float:
        """Share of SYNCs that are later than half a period."""
        return late_share(self.lateness_ns, self.period_ns)

    def as_document(self) -> dict[str, Any]:
        """The figures for JSON."""
        names = ["torn", "array_silent", "load", "planned_load", "foreign_hz"]
        names += ["queue_full", "dropped", "error_frames", "passive"]
        return {
            "rate_hz": 1e9 / self.period_ns,
            "cycles": self.cycles,
            "sync_late_us": {name: us(quantile(self.lateness_ns, share)) for name, share in QUANTILES.items()},
            "overruns_percent": 100.0 * self.late_share(),
            "waits_us": us(self.wait_ns),
            "cycle_us": us(self.usual_ns),
            "nodes": [one.as_document() for one in self.answers],
            **{name: getattr(self, name) for name in names},
            "failure": self.failure,
        }


IDLE_FAST_NS = 1_000_000
"""Period of the faster loop that does nothing."""
QUANTILES = {"p50": 0.5, "p99": 0.99, "p999": 0.999, "max": 1.0}


def late_share(lateness_ns: Sequence[int], period_ns: int) -> float:
    """Share of wake-ups that are later than half a period."""
    return sum(late > period_ns // 2 for late in lateness_ns) / max(1, len(lateness_ns))


def quantile(ascending: Sequence[int], share: float) -> int | None:
    """Quantile of sorted values; None of none."""
    return ascending[min(len(ascending) - 1, int(share * len(ascending)))] if ascending else None


def us(time_ns: int | None) -> float | None:
    """Time in µs."""
    return None if time_ns is None else time_ns * 1e-3
