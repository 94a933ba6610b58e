"""Creep of the measured force, corrected by two relaxations.

Under a constant load the reading of a taxel grows by a share c with each decade of time, and falls as slowly when the
load is gone. Creep is linear in the load, so that the sum over the array creeps as one taxel does, wherever the patch
moves. The law over decades is a sum of two relaxations r, a decade and a half apart, each of strength 1.5 c:

    F_shown = F + 1.5 c (r_1 + r_2),   τ_i dr_i/dt = F − r_i.

From 0.3 s to 60 s this departs from a law of four relaxations a decade apart by 0.1 c at most; after ten minutes by
0.9 c, which is part of the standard deviation. Source: Findley, Lai and Onaran, "Creep and relaxation of nonlinear
viscoelastic materials", ch. 5.
"""

from __future__ import annotations

import math

TIME_CONSTANTS_S = (0.5, 15.0)
"""Time constants of the relaxations, s."""
DECADES_EACH = math.log10(TIME_CONSTANTS_S[1] / TIME_CONSTANTS_S[0])
"""Decades of time that one relaxation stands for."""
LATE_S = 4.0 * TIME_CONSTANTS_S[1]
"""Time after a touch from which on creep goes on and the relaxations do not, s."""
MAX_MEMORY_SHARE = 0.5
"""Largest share of a reading that is taken for the memory of earlier loads: threshold and cover hide some of it."""


def decades_after(seconds: float) -> float:
    """Decades of creep after a time under a constant load, as the relaxations follow them."""
    return DECADES_EACH * sum(1.0 - math.exp(-seconds / tau) for tau in TIME_CONSTANTS_S)


def late_decades_after(seconds: float) -> float:
    """Decades of time beyond `LATE_S`, which the relaxations do not follow."""
    return math.log10(max(seconds / LATE_S, 1.0))


class ForceCreep:
    """Follows the load of one array through its readings.

    Args:
        growth: growth of the reading per decade of time, relative; 0: the load is followed and nothing is corrected.
    """

    def __init__(self, growth: float) -> None:
        self._strength = growth * DECADES_EACH
        self._relaxed = [0.0] * len(TIME_CONSTANTS_S)
        self._t_s: float | None = None
        self._since_s: float | None = None

    def step(self, t_s: float, shown: float, *, touching: bool = True) -> float:
        """Take the force that is shown at a time, not before the last one; returns it without creep, N.

        Args:
            t_s: time, s.
            shown: force by the sum of pressures, N.
            touching: whether there is a contact.
        """
        dt = 0.0 if self._t_s is None else max(t_s - self._t_s, 0.0)
        self._t_s = t_s
        if not touching:
            self._since_s = None
        elif self._since_s is None:
            self._since_s = t_s
        kept = [math.exp(-dt / tau) for tau in TIME_CONSTANTS_S]
        memory = self._strength * sum(k * r for k, r in zip(kept, self._relaxed, strict=True))
        # the load creeps within the step, too: with the relaxations of before, a force of 5 % creep a decade would be
        # 0.7 % off at 20 images a second, and 5 % after half a second without one
        at_once = self._strength * sum(1.0 - k for k in kept)
        force = max(shown - memory, (1.0 - MAX_MEMORY_SHARE) * shown) / (1.0 + at_once)
        self._relaxed = [k * r + (1.0 - k) * force for k, r in zip(kept, self._relaxed, strict=True)]
        return force

    @property
    def decades_n(self) -> float:
        """What a growth of 1 per decade adds to the reading, N: the force times the decades that it has pressed for."""
        return DECADES_EACH * sum(self._relaxed)

    @property
    def late_decades(self) -> float:
        """Decades of time since the touch beyond `LATE_S`."""
        if self._since_s is None or self._t_s is None:
            return 0.0
        return late_decades_after(self._t_s - self._since_s)
