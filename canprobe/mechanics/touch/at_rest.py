"""Reasons, seen in the samples of a touch at rest, not to go on: the force swings, or the array cannot show it."""

from __future__ import annotations

import math

from canprobe.mechanics.touch.stops import MAX_FORCE_SPREAD

MAX_SATURATED_SHARE = 0.75
"""Share of saturated samples above which the measured force is only a lower bound of the true one.

Saturation alone is no reason to stop: up to 40 kN/m the bound is near enough. Where √F did not grow on a line either,
it is not.
"""
MIN_REST_SAMPLES = 10
"""Least number of samples that are judged."""


class AtRest:
    """Spread and saturation from running means (Welford): constant time and memory."""

    def __init__(self) -> None:
        self._n = self._saturated = 0
        self._mean = self._spread = 0.0

    def add(self, force: float, saturated: bool) -> None:
        """Take a force (N), and whether a taxel was at its largest count."""
        self._n += 1
        self._saturated += saturated
        from_mean = force - self._mean
        self._mean += from_mean / self._n
        self._spread += from_mean * (force - self._mean)

    def doubt(self, target: float, stiffness_known: bool) -> str | None:
        """Why the force is not the wanted one; None where it is, or where that is not known yet.

        Args:
            target: wanted force, N.
            stiffness_known: whether the touch showed the layer's stiffness (`PushFit`).
        """
        if self._n < MIN_REST_SAMPLES:
            return None
        if not stiffness_known and self._saturated > MAX_SATURATED_SHARE * self._n:
            return (
                f"the array is saturated in {100.0 * self._saturated / self._n:.0f} % of the samples and no stiffness "
                f"was measured: the true force is above the measured {self._mean:.1f} N; raise sensor.full_scale_kpa "
                "or lower task.force_n"
            )
        sigma = math.sqrt(self._spread / (self._n - 1))
        if sigma > MAX_FORCE_SPREAD * target:
            return (
                f"the force does not settle: {self._mean:.1f} ± {sigma:.1f} N where {target:.1f} N are wanted; the "
                "contact is too stiff for the arm's encoder counts, or servo.surface_height_hz too high"
            )
        return None
