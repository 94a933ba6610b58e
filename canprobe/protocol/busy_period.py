"""The longest delay of one message behind a given alignment of everything of higher priority. Integers, ns.

Source: Davis, Burns, Bril, Lukkien 2007 (busy period, non-preemptive start); Palencia and González Harbour,
"Schedulability analysis for tasks with static and dynamic offsets", RTSS 1998 (phases within a transaction); Tindell
and Burns 1994 (errors).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple


class Arrivals(NamedTuple):
    """When the frames of one message are queued in a busy period that begins at 0.

    Attributes:
        cost: time of one frame.
        period: between two releases.
        early: releases before 0 that jitter has held back until then.
        first: the first release after those, 0 ≤ first < period.
    """

    cost: int
    period: int
    early: int
    first: int

    @classmethod
    def behind(cls, cost: int, period: int, jitter: int, phase: int) -> Arrivals:
        """A message released at `phase` (mod period) and queued up to `jitter` later, at the worst."""
        first = phase % period
        return cls(cost, period, (jitter + first) // period, first)

    def before(self, t: int) -> int:
        """Frames queued in [0, t), at most."""
        return self.early + max(0, -((self.first - t) // self.period))

    def release(self, instance: int) -> int:
        """When the event of an instance was, counted from 0; negative for the early ones."""
        return self.first + (instance - self.early) * self.period


@dataclass(frozen=True, slots=True)
class Level:
    """One message and all above it, in one alignment.

    Attributes:
        own: the message.
        above: everything of higher priority.
        blocking: of the longest frame of lower priority.
        bit: a bit time: a frame queued so late can still win the arbitration.
        errors: errors of a burst.
        error_period: shortest time between two further errors; None: there are none.
        error_cost: what each error costs.
    """

    own: Arrivals
    above: Sequence[Arrivals]
    blocking: int
    bit: int
    errors: int = 0
    error_period: int | None = None
    error_cost: int = 0

    def lost(self, t: int) -> int:
        """Time that errors take within t, at most."""
        count = self.errors + (-(-t // self.error_period) if self.error_period is not None else 0)
        return count * self.error_cost

    def busy(self) -> int:
        """Length of the busy period. Source: Davis et al. 2007."""
        length = 1
        level = (self.own, *self.above)
        while True:
            longer = self.blocking + self.lost(length) + _demand(level, length)
            if longer <= length:
                return length
            length = longer

    def finished(self) -> list[tuple[int, int]]:
        """Of each instance of the message in the busy period: when its event was, and when its last bit is through."""
        busy, cost = self.busy(), self.own.cost
        found, delay = [], 0
        for instance in range(self.own.before(busy)):
            delay = self._started(max(delay, self.blocking + instance * cost), instance * cost)
            found.append((self.own.release(instance), delay + cost))
        return found

    def _started(self, delay: int, own: int) -> int:
        """Smallest w at which nothing is before the message, searched upward. Source: Davis et al. 2007."""
        while True:
            longer = self.blocking + own + self.lost(delay + self.own.cost) + _demand(self.above, delay + self.bit)
            if longer <= delay:
                return delay
            delay = longer


def _demand(messages: Sequence[Arrivals], t: int) -> int:
    """Time that the frames queued in [0, t) take; `Arrivals.before`, where it is called most."""
    demand = 0
    for cost, period, early, first in messages:
        later = -((first - t) // period)
        demand += (early + later if later > 0 else early) * cost
    return demand
