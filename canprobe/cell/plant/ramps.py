"""The reference of a drive: straight ramps of counts, one after the other; the end of a ramp is held."""

from __future__ import annotations

from collections.abc import Sequence

NEVER = 1 << 62
"""A time, ns, that no run reaches."""
Ramp = tuple[int, int, float, float]
"""Start and end time (ns), start and end (counts)."""


class Reference:
    """Reference of one motor.

    Args:
        counts: position until the first ramp.
    """

    __slots__ = ("_ramps",)

    def __init__(self, counts: float) -> None:
        self._ramps: list[Ramp] = [(-1, -1, counts, counts)]

    def add(self, ramp: Ramp, now_ns: int) -> None:
        """Follow a ramp from its start on, or from now on where it began in the past; drops what was to come later.

        Args:
            ramp: not before the ramps that act already.
            now_ns: the present time.
        """
        last = self._ramps[-1]
        if last[0] <= now_ns and last[0] < ramp[0]:
            self._ramps = [last, ramp]
            return
        start = max(ramp[0], now_ns)
        kept: Sequence[Ramp] = [r for r in self._ramps if r[0] < start or r[0] < 0]
        past = [r for r in kept if r[0] <= now_ns]
        self._ramps = [*past[-1:], *(r for r in kept if r[0] > now_ns), ramp]

    def at(self, t_ns: int) -> tuple[float, float]:
        """Reference (counts) and its slope (counts/s) from t on.

        Args:
            t_ns: not before the last ramp that began.
        """
        t0, t1, start, end = self._ramps[-1]
        if t0 > t_ns:
            t0, t1, start, end = next(r for r in reversed(self._ramps) if r[0] <= t_ns)
        if t_ns >= t1:
            return end, 0.0
        slope = (end - start) / (t1 - t0)
        return start + slope * (t_ns - t0), 1e9 * slope

    def next_bend(self, t_ns: int) -> int:
        """First time after t at which the slope may change, ns.

        Args:
            t_ns: ns.
        """
        bend = NEVER
        for t0, t1, _, _ in self._ramps:
            if t_ns < t0 < bend:
                bend = t0
            if t_ns < t1 < bend:
                bend = t1
        return bend
