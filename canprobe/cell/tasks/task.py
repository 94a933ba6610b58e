"""Data that a task leaves for the summary."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.controller import Controller

if TYPE_CHECKING:
    from canprobe.cell.tasks.shape import ShapeTracker
    from canprobe.mechanics.robot.tool_calibration import ToolEstimate


USUAL_SPEED = 0.1
"""Share of the speed limits that a motion by hand has where nothing else is asked for."""
MAX_STEP_PERIODS = 4
"""Largest step of a motion in a cycle, and largest time that it makes up later, in periods; the rest is lost."""
STEP_GROWTH_DIVISOR = 8
"""A step of a motion is longer than the one before by at most a period over this."""


class Phase(IntEnum):
    """Phases of a touch task, in their order; a scan that loses its contact goes to and fro between it and REGAIN."""

    MOVE = 0
    APPROACH = 1
    SETTLE = 2
    SCAN = 3
    RETREAT = 4
    DONE = 5
    REGAIN = 6


class MotionTime:
    """The time of a motion. It follows the cycles, also where all of them take long, but not from one to the next.

    After a late cycle the target goes on with an eighth more in each cycle until the motion has made up for it: at
    once, the probe would be pushed by the way of four cycles into what it touches.

    Args:
        period_ns: period of the cycle.
    """

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._last_ns: int | None = None
        self._step_ns, self._owed_ns = period_ns, 0

    def step(self, t_ns: int) -> int:
        """Step of the motion in the cycle at ``t_ns``, ns; one period in the first cycle."""
        passed_ns = self._period_ns if self._last_ns is None else t_ns - self._last_ns
        self._last_ns = t_ns
        due_ns, longest_ns = self._owed_ns + passed_ns, MAX_STEP_PERIODS * self._period_ns
        self._step_ns = min(due_ns, self._step_ns + self._period_ns // STEP_GROWTH_DIVISOR, longest_ns)
        self._owed_ns = min(due_ns - self._step_ns, longest_ns)
        return self._step_ns


@dataclass(slots=True)
class Loss:
    """A loss of contact in a scan.

    Attributes:
        cycle: cycle in which it was noticed.
        searched: distance that the probe went towards the object, m.
        regained_s: time from there to the new touch; None without one.
    """

    cycle: int
    searched: float = 0.0
    regained_s: float | None = None

    @property
    def summarised(self) -> dict[str, float | None]:
        """The loss in ``summary.json``: `regained_after_ms` is None where the contact was not regained."""
        after_ms = None if self.regained_s is None else 1e3 * self.regained_s
        return {"searched_mm": 1e3 * self.searched, "regained_after_ms": after_ms}


@dataclass(frozen=True, slots=True)
class TaskRecord:
    """The results of a task at its end; a user's own controller leaves an empty record.

    Attributes:
        shape: the estimator's contacts and answers; None where no shape was asked for.
        tool: the probe's centre as a calibration found it.
        taxels: last image of the touch.
        losses: lost contacts of a scan.
        scan_cycles: first cycle of the scan or hold, and the one after its last; None before.
        unplaced: contacts that were not used because the joints of their instant are unknown.
        slowed: cycles in which a joint could not keep up with the probe's path.
        explored: the section ``explore`` of ``summary.json``; None where nothing was explored.
        depth_watched: share of the contacts at which the depth said something of the force; None without contacts.
    """

    shape: ShapeTracker | None = None
    tool: ToolEstimate | None = None
    taxels: NDArray[np.uint8] | None = None
    losses: Sequence[Loss] = ()
    scan_cycles: tuple[int, int] | None = None
    unplaced: int = 0
    slowed: int = 0
    explored: dict[str, Any] | None = None
    depth_watched: float | None = None


class Task(Controller):
    """A controller that carries out the task of a scene."""

    def record(self) -> TaskRecord:
        """The results so far."""
        return TaskRecord()


def record_of(controller: Controller | None) -> TaskRecord:
    """The record of any controller, packaged or the user's."""
    return controller.record() if isinstance(controller, Task) else TaskRecord()
