"""The limits of image and force at which a touch is stopped.

The plan uses the same numbers, so that a scene that it accepts is not stopped by them.
"""

from __future__ import annotations

import math

TORQUE_MEAN_NS = 25_000_000
"""Time over which torques are averaged for the push that they show; two in a row must show a push."""
PUSH_SIGMAS = 4.0
"""Standard deviations from which on a push in the torques is none by chance: it is looked for forty times a second."""
LEAST_PUSH_SHARE = 0.5
"""Share of the force limit below which no push counts, however well the torques are known."""
OFF_PAD_EDGE_SHARE = 0.95
"""Pressure at the pad's edge over the highest pressure from which on a contact counts as off the pad: a paraboloid has
lost a sixth of its force by then."""
OFF_PAD_ACROSS_SHARE = 0.5
"""The same at two opposite edges: a contact that lies across the whole pad goes on beyond both, as a cylinder's on a
flat array, whatever the gains of single taxels."""
OFF_PAD_SIGMAS, OFF_PAD_TAXELS = 1.55, 1.0
"""The same limit where only moments are known: distance of the centroid from the edge, in standard deviations of the
pressure (the width of a taxel included), and in taxels. A paraboloid has lost a fourth of its force by the first; one
of which only a rim is left has its centroid in the last row of taxels."""
TOUCH_FORCE = 0.15
"""Force above which there is contact, N, and below half of which there is none: an image of less force does not show
the place of the contact."""
MAX_FORCE_SPREAD = 0.2
"""Largest standard deviation of a settled force over its target: twice that of a contact of 40 kN/m."""
MAX_SATURATED_SHARE = 0.75
"""Share of saturated samples above which the measured force is only a lower bound of the true one.

Saturation alone is no reason to stop: up to 40 kN/m the bound is near enough. Where √F did not grow on a line either,
it is not.
"""
MAX_BRIDGED_SHARE = 0.5
"""Share of the force, interpolated over taxels that do not measure, up to which it is known. Over 200 random presses
its error was below 5 % with one dead row and below 7 % with two that were found; beyond half of the force 6 to 20 %."""
MIN_REACHED_SHARE = 0.5
"""Least share of the wanted force at rest: where one count of the drives is deeper, the force stays where it is."""
MIN_REST_SAMPLES = 5
"""Least number of samples that are judged."""


def depth_on_plane(force: float, stiffness: float, radius: float) -> float:
    """Indentation of the layer of a sphere on a plane, m: `F = π k R δ²`.

    Args:
        force: N.
        stiffness: K/h of the layer, N/m³.
        radius: radius of the sphere, m.
    """
    return math.sqrt(force / (math.pi * stiffness * radius))


def depth_on_bluntest(force: float, stiffness: float, reach: float) -> float:
    """Indentation of a flat layer, m, by the bluntest ball whose patch fits on it: half width `a = √(2Rδ)`.

    Args:
        force: N.
        stiffness: K/h of the layer, N/m³.
        reach: distance from the middle to the nearest edge, m.
    """
    return 2.0 * force / (math.pi * stiffness * reach**2)


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
        reached = self._mean >= MIN_REACHED_SHARE * target or self._saturated
        if sigma > MAX_FORCE_SPREAD * target or not reached:
            what = "the force does not settle" if reached else "the force is not reached"
            return (
                f"{what}: {self._mean:.1f} ± {sigma:.1f} N where {target:.1f} N are wanted; the contact is "
                "too stiff for the arm's encoder counts, or servo.surface_height_hz too high"
            )
        return None
