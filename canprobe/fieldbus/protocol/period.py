"""Sampling instants of a free-running device, from the arrivals of its frames: a line through the last of them.

A device that samples on its own time has a steady period; what it sends waits for the bus, for a driver, for the
receiver. The instants are `t0 + n·T`, fitted by least squares to the last `MAX_ARRIVALS` arrivals. Each has its number
n, which steps over images that were lost. The mean delay of the frames is in t0: it is part of the latency.
The fit stops being true where the device changes its period, or where arrivals scatter by more than a quarter of it.
"""

from __future__ import annotations

import math
from collections import deque

MAX_ARRIVALS = 64
"""Most arrivals in the fit."""
MIN_ARRIVALS = 4
"""Fewest arrivals for a fit."""
MAX_ERROR_SHARE = 0.25
"""Share of the period by which an arrival, and the fitted period, may be off; beyond it the fit begins anew."""


class PeriodFit:
    """Fits a period to arrivals.

    Args:
        period_ns: stated period; it gives the number of lost images until there is a fit.

    Attributes:
        period_ns: fitted period.
        restarts: how often the fit began anew.
    """

    def __init__(self, period_ns: float) -> None:
        self.period_ns = self._stated_ns = period_ns
        self.restarts = 0
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=MAX_ARRIVALS)

    def step(self, t_ns: int) -> tuple[int, float]:
        """Add an arrival to the fit.

        Args:
            t_ns: arrival of the first frame of an image, after that of the image before.

        Returns:
            The fitted instant of this image, ns, and its standard deviation, s. Without a fit they are the arrival, and
            the deviation of an instant that lies anywhere in a period.
        """
        arrivals = self._arrivals
        number = 0
        if arrivals:
            before, last_ns = arrivals[-1]
            number = before + max(1, round((t_ns - last_ns) / self.period_ns))
        arrivals.append((number, t_ns))
        if len(arrivals) < MIN_ARRIVALS:
            return t_ns, 1e-9 * self._stated_ns / math.sqrt(12.0)
        count = len(arrivals)
        numbers, times = [n - number for n, _ in arrivals], [t - t_ns for _, t in arrivals]  # from this one: small
        mean_n, mean_t = sum(numbers) / count, sum(times) / count
        squares = sum((n - mean_n) ** 2 for n in numbers)
        period = sum((n - mean_n) * t for n, t in zip(numbers, times, strict=True)) / squares
        rests = [t - mean_t - period * (n - mean_n) for n, t in zip(numbers, times, strict=True)]
        if max(abs(rests[-1]), abs(period - self._stated_ns)) > MAX_ERROR_SHARE * self._stated_ns:
            self._arrivals.clear()
            self._arrivals.append((0, t_ns))
            self.period_ns = self._stated_ns
            self.restarts += 1
            return t_ns, 1e-9 * self._stated_ns / math.sqrt(12.0)
        self.period_ns = period
        variance = sum(rest * rest for rest in rests) / (count - 2) * (1.0 / count + mean_n**2 / squares)
        return t_ns + round(mean_t - period * mean_n), 1e-9 * math.sqrt(variance)
