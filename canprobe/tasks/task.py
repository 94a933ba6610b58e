"""What a task leaves for the summary, besides what it did as a controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.controller import Controller

if TYPE_CHECKING:
    from canprobe.robot.tool_calibration import ToolEstimate
    from canprobe.tasks.shape import ShapeTracker


LONGEST_STEP = 4
"""Periods that one command makes up for at most after an overrun; the rest of a longer stall is lost time."""


def step_ns(t_ns: int, last_ns: int, period_ns: int) -> int:
    """By how much a motion goes on from one cycle to the next, ns: the time between them, within a bound."""
    return min(t_ns - last_ns, LONGEST_STEP * period_ns)


@dataclass(slots=True)
class Loss:
    """One time that a scan lost its contact.

    Attributes:
        cycle: in which it was noticed.
        searched: how far the probe went towards the object, m.
        regained_s: time from there to the new touch; None without one.
    """

    cycle: int
    searched: float = 0.0
    regained_s: float | None = None


@dataclass(frozen=True, slots=True)
class TaskRecord:
    """What a task knows at its end; a user's own controller leaves an empty one.

    Attributes:
        shape: the estimator's contacts and answers; None where no shape was asked for.
        tool: the probe's centre as a calibration found it.
        taxels: last image of the touch.
        losses: lost contacts of a scan.
        scan_cycles: first cycle of the scan or hold, and the one after its last; None before.
        unplaced: contacts that were not used because the joints of their instant are unknown.
        slowed: cycles in which a joint could not keep up with the probe's path.
    """

    shape: ShapeTracker | None = None
    tool: ToolEstimate | None = None
    taxels: NDArray[np.uint8] | None = None
    losses: Sequence[Loss] = ()
    scan_cycles: tuple[int, int] | None = None
    unplaced: int = 0
    slowed: int = 0


class Task(Controller):
    """A controller that carries out the task of a scene."""

    def record(self) -> TaskRecord:
        """What it knows so far."""
        return TaskRecord()


def record_of(controller: Controller | None) -> TaskRecord:
    """What a controller left, whoever wrote it."""
    return controller.record() if isinstance(controller, Task) else TaskRecord()
