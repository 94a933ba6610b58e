"""The lift-off at the end of a log: what the cell began it for need not be on the bus, but its targets are its own."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.lift_off import WayBack
from canprobe.cell.log_cycles import LogCycle
from canprobe.planning.model import Plan
from canprobe.robot.puma260 import PumaModel, joints_to_counts

Vector = NDArray[np.float64]
TARGET_TOLERANCE = 1
"""Counts that a replayed target may differ from the recorded one by rounding."""
SHORTEST = 8
"""Cycles that tell a lift-off from what a task does: by then it has moved most of a millimetre."""
UNTOLD = 2
"""Cycles behind a lift-off in which the drives were told nothing: its last one, and the first of the stop."""


class LoggedWayBack:
    """Finds the lift-off among the last cycles of a controller, and what it should have told the drives.

    Args:
        plan: of the cell.

    Attributes:
        steps: its cycles with the joint targets (6,), rad, that belong to them; empty where there was none.
    """

    def __init__(self, plan: Plan) -> None:
        arm = plan.setup.arm
        assert arm is not None
        self.steps: list[tuple[LogCycle, Vector]] = []
        self._model = arm.model
        self._flange_probe = plan.setup.probe.T_flange_probe
        self._period_s = plan.sync.period_ns * 1e-9

    @property
    def begun_s(self) -> float | None:
        """When it began; None where there was none."""
        return self.steps[0][0].measurement.t_ns * 1e-9 if self.steps else None

    def cycles_before(self, cycles: Iterable[LogCycle]) -> Iterator[LogCycle]:
        """The controller's own cycles; those of the lift-off, if one ends them, are `steps` afterwards."""
        last: deque[LogCycle] = deque()
        for cycle in cycles:
            last.append(cycle)
            if len(last) > WayBack.cycles(self._period_s) + 1:
                yield last.popleft()
        begun = self._find(list(last))
        yield from (last.popleft() for _ in range(begun))

    def _find(self, last: list[LogCycle]) -> int:
        """How many of the last cycles are not the lift-off's."""
        for first in range(1, len(last) - SHORTEST + 1):
            steps = self._steps_from(last[first - 1], last[first:])
            if steps is not None:
                self.steps = steps
                return first
        return len(last)

    def _steps_from(self, before: LogCycle, cycles: list[LogCycle]) -> list[tuple[LogCycle, Vector]] | None:
        """The targets of a lift-off in these cycles; None where the recorded ones are others."""
        if before.targets is None:
            return None
        targets, free = np.array(before.targets, dtype=float), np.ones(len(before.targets), dtype=bool)
        way = WayBack(self._model, self._flange_probe, self._period_s, free, targets)
        steps: list[tuple[LogCycle, Vector]] = []
        for i, cycle in enumerate(cycles):
            q = way.step(cycle.measurement.q) if cycle.measurement.q is not None else None
            if q is None or cycle.targets is None or worst_count(self._model, q, cycle.targets) > TARGET_TOLERANCE:
                ended = len(cycles) - i <= UNTOLD and all(c.targets == cycles[i - 1].targets for c in cycles[i:])
                return steps if ended and i >= SHORTEST else None
            steps.append((cycle, q))
        return steps


def worst_count(model: PumaModel, q: Vector, targets: tuple[int, ...]) -> int:
    """By how much joint angles (6,), rad, and recorded motor targets differ, counts."""
    return int(np.abs(np.round(joints_to_counts(model, q)) - targets).max())
