"""The way that a probe has come: measured joint positions of its last millimetres, and the way back on them.

They were free. Whatever the gear, the tool or the calibration is in truth, the same motor positions in reverse lead off
what the probe has run into; a way that is computed leads there only as far as the cell file is right.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.types import Floats

WAY_BACK = 6e-3
"""Length of a way back, m: further than the softest pad is pressed in."""
WAY_BACK_SPEED = 20e-3
"""Mean speed of a way back, m/s; it begins with nearly twice as much, which then falls to zero."""
START_S = 0.02
"""Time to the highest speed of a way back on the trail."""
ARRIVAL_S = 0.02
"""Time for the drives to make up their lag at the end."""
KNOT_RAD = 0.5e-3
"""Motion of a joint between two positions that are kept, rad: 0.15 mm at the tip, more than encoders are noisy."""
MAX_KNOTS = 256
"""Number of positions that are kept: a turn about the tip has no way of the probe, and no end."""
GROWTH_SHARE, GROWTH_N = 0.1, 0.075
"""Share and amount by which the force has to grow on a way back to count: noise, and half of a touch."""


def way_gone(t: float) -> float:
    """Way after ``t`` seconds of a way back that leaves with twice its mean speed, m."""
    return WAY_BACK * (1.0 - max(1.0 - t * WAY_BACK_SPEED / WAY_BACK, 0.0) ** 2)


class TakenWay:
    """Measured joint positions of the last `WAY_BACK` of the probe's way, as many as tell it.

    Args:
        model: the arm's geometry.
        flange_point: transform (4, 4) from the point whose way counts to the flange.
    """

    def __init__(self, model: ArmModel, flange_point: Floats) -> None:
        self._model, self._flange_point = model, flange_point
        self._knots: deque[tuple[list[float], Floats, float]] = deque(maxlen=MAX_KNOTS)
        self._least: list[float] = (KNOT_RAD * model.radian).tolist()

    def forget(self) -> None:
        """Forget the way: it no longer leads off what the probe touches."""
        self._knots.clear()

    def add(self, measured: Floats | None, ages: Sequence[int]) -> None:
        """Take the joints of a cycle (n,), rad or m, and their ages, cycles; they count where all are of this cycle."""
        if measured is None or any(ages):
            return
        q, knots = measured.tolist(), self._knots
        if knots and all([abs(a - b) < least for a, b, least in zip(q, knots[-1][0], self._least, strict=True)]):
            return
        place = (forward(self._model.chain, measured) @ self._flange_point)[:3, 3]
        gone = knots[-1][2] + float(np.linalg.norm(place - knots[-1][1])) if knots else 0.0
        knots.append((q, place, gone))
        # by the second: the first that stays lies beyond the end of the way back, which is between the two
        while len(knots) > 2 and gone - knots[1][2] > WAY_BACK:
            knots.popleft()

    def back(self, q: Floats, step_max: Floats) -> Retrace | None:
        """The way back from measured joints (n,), rad or m; None where nothing is known of the way.

        Args:
            q: where the arm stands.
            step_max: largest step of each joint in a period (n,), rad or m.
        """
        if not self._knots:
            return None
        place = (forward(self._model.chain, q) @ self._flange_point)[:3, 3]
        gone = self._knots[-1][2] + float(np.linalg.norm(place - self._knots[-1][1]))
        ways = gone - np.array([gone, *(knot[2] for knot in reversed(self._knots))])
        joints = np.array([q, *(knot[0] for knot in reversed(self._knots))])
        return Retrace(ways, joints, step_max)


class Retrace:
    """The way back over measured joints, by its length: a quick start, then slower to the end.

    Args:
        ways: (k,) way of the probe to each of the joint positions, ascending from 0, m.
        joints: (k, n) joint positions, rad or m.
        step_max: largest step of each joint in a period (n,), rad or m.
    """

    def __init__(self, ways: Floats, joints: Floats, step_max: Floats) -> None:
        self._ways, self._joints, self._step_max = ways, joints, step_max
        self._t, self.q = 0.0, joints[0]

    def step(self, dt: float) -> Floats | None:
        """Joint targets (n,), rad or m, a time ``dt`` s later; None at the end."""
        if self._t > START_S + WAY_BACK / WAY_BACK_SPEED + ARRIVAL_S:
            return None
        wanted = self._at(self._t + dt)
        share = float(np.max(np.abs(wanted - self.q) / self._step_max))
        if share > 1.0:
            wanted, dt = self._at(self._t + dt / share), dt / share
        self._t += dt
        self.q = wanted
        return wanted

    def _at(self, t: float) -> Floats:
        # from rest: the time of the way gets going within START_S, evenly, and is half of that behind afterwards
        gone = way_gone(t - START_S / 2 if t > START_S else t * t / (2.0 * START_S))
        return np.array([np.interp(gone, self._ways, column) for column in self._joints.T])


class GrowingForce:
    """Whether the measured force grows on a way back: the array as its witness.

    What it measures at first is from before the way back, and grows with the motion that was under way.

    Args:
        cycles: cycles after which it measures the way back.
    """

    def __init__(self, cycles: int) -> None:
        self._cycles = cycles
        self._begin: int | None = None
        self._highest = 0.0

    def grows(self, cycle: int, force: float, *, a_part: bool) -> bool:
        """Take the force of a cycle; whether it has grown beyond what it was as the way back began.

        Args:
            cycle: number of the cycle.
            force: measured force, N.
            a_part: it is a part of the true one: the array is saturated, or the contact runs off it.
        """
        if self._begin is None:
            self._begin = cycle
        if a_part and force > GROWTH_N:  # noise in a taxel at the edge runs off the array, too
            force = math.inf
        if cycle - self._begin < self._cycles:
            self._highest = max(self._highest, force)
        return force > self._highest * (1.0 + GROWTH_SHARE) + GROWTH_N
