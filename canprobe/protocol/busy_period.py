"""The longest delay of one message behind everything of higher priority, in all alignments at once. Integers, ns.

Source: Davis, Burns, Bril, Lukkien 2007 (busy period, non-preemptive start); Palencia and González Harbour,
"Schedulability analysis for tasks with static and dynamic offsets", RTSS 1998 (phases within a transaction); Tindell
and Burns 1994 (errors).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]


class Arrivals(NamedTuple):
    """When the frames of m messages are queued in n busy periods that begin at 0.

    Attributes:
        cost: (m,) time of one frame.
        period: (m,) between two releases.
        early: (n, m) releases before 0 that jitter has held back until then.
        first: (n, m) the first release after those, 0 ≤ first < period.
    """

    cost: Integers
    period: Integers
    early: Integers
    first: Integers

    @classmethod
    def behind(cls, cost: Integers, period: Integers, jitter: Integers, phase: Integers) -> Arrivals:
        """Messages released at `phase` (n, m) (mod period) and queued up to `jitter` (m,) later, at the worst."""
        first = phase % period
        return cls(cost, period, (jitter + first) // period, first)

    def before(self, t: Integers) -> Integers:
        """Frames (n, m) queued in [0, t) (n,), at most."""
        later = self.first - t[:, None]
        later //= self.period
        np.negative(later, out=later)
        np.maximum(later, 0, out=later)
        later += self.early
        return later

    def demand(self, t: Integers) -> Integers:
        """Time (n,) that the frames queued in [0, t) take."""
        return np.asarray(self.before(t) @ self.cost, dtype=np.int64)

    def columns(self, which: slice) -> Arrivals:
        """Of some of the messages."""
        return Arrivals(self.cost[which], self.period[which], self.early[:, which], self.first[:, which])

    def rows(self, which: NDArray[np.bool_]) -> Arrivals:
        """In some of the busy periods."""
        return self._replace(early=self.early[which], first=self.first[which])


@dataclass(frozen=True, slots=True)
class Level:
    """One message and all above it, in n alignments.

    Attributes:
        arrivals: of everything of higher priority and, last, of the message.
        blocking: (n,) of the longest frame of lower priority.
        bit: a bit time: a frame queued so late can still win the arbitration.
        errors: errors of a burst.
        error_period: shortest time between two further errors; None: there are none.
        error_cost: what each error costs.
    """

    arrivals: Arrivals
    blocking: Integers
    bit: int
    errors: int = 0
    error_period: int | None = None
    error_cost: int = 0

    def lost(self, t: Integers) -> Integers | int:
        """Time (n,) that errors take within t (n,), at most."""
        further = 0 if self.error_period is None else -(-t // self.error_period)
        return (self.errors + further) * self.error_cost

    def busy(self) -> Integers:
        """Lengths (n,) of the busy periods. Source: Davis et al. 2007."""
        length = np.ones_like(self.blocking)
        while True:
            longer = self.blocking + self.lost(length) + self.arrivals.demand(length)
            if (longer <= length).all():
                return length
            length = np.maximum(length, longer)

    def worst(self) -> tuple[int, int]:
        """From a release of the message to its last bit, at most, and the most instances in one busy period."""
        own = self.arrivals.columns(slice(-1, None))
        cost = int(own.cost[0])
        instances = own.before(self.busy())[:, 0]
        left, counts = self, instances
        delay, found = np.zeros_like(self.blocking), []
        for instance in range(int(instances.max())):
            if (some := counts > instance).sum() < len(some):
                own, counts, delay, left = own.rows(some), counts[some], delay[some], left._rows(some)
            delay = left._started(np.maximum(delay, left.blocking + instance * cost), instance * cost)
            release = own.first[:, 0] + (instance - own.early[:, 0]) * own.period[0]
            found.append(int((delay + cost - release).max()))
        return max(found), int(instances.max())

    def _started(self, delay: Integers, own: int) -> Integers:
        """Smallest w (n,) at which nothing is before the message, searched upward. Source: Davis et al. 2007."""
        above, cost = self.arrivals.columns(slice(-1)), int(self.arrivals.cost[-1])
        while True:
            longer = self.blocking + own + self.lost(delay + cost) + above.demand(delay + self.bit)
            if (longer <= delay).all():
                return delay
            delay = np.maximum(delay, longer)

    def _rows(self, which: NDArray[np.bool_]) -> Level:
        return Level(
            self.arrivals.rows(which), self.blocking[which], self.bit, self.errors, self.error_period, self.error_cost
        )
