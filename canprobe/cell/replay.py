"""A recorded log → the contacts and estimates of the run: by the scene's own task, or from the contacts alone."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.build import make_task
from canprobe.cell.limits import limits_of
from canprobe.cell.log_cycles import LogCycle
from canprobe.cell.logged_way_back import TARGET_TOLERANCE, LoggedWayBack, worst_count
from canprobe.cell.supervision import TOUCH_FORCE
from canprobe.cell.tasks.build import make_sensing, make_shape_tracker
from canprobe.cell.tasks.shape import ShapeTracker
from canprobe.cell.tasks.touch import TouchTask
from canprobe.planning.model import Plan
from canprobe.scene_setup import Touch

Vector = NDArray[np.float64]
OWN_COUNTS = 20
"""Median difference up to which the task drove: 0.5 mm or 0.2 deg. One lost line is a few counts for a while."""
PARTED_COUNTS = 100
"""Difference at which the recorded targets are not the task's: 2 mm or 1 deg."""
PARTED_S = 0.1
"""Time at that difference after which they never will be again: what a lost line sets off, the servo has mended."""


@dataclass(frozen=True, slots=True)
class TaskReplay:
    """What the scene's task did on the recorded measurements.

    Attributes:
        task: the task, at its end.
        compared: cycles with recorded targets beside its own.
        differing: of these, where a target differed by more than ``TARGET_TOLERANCE``.
        median_counts, worst_counts: the usual and the largest difference.
        lifted_s: when the cell began to lift off, whatever it did so for, and ended the task's replay (s); else None.
        parted_s: when the recorded targets had left the task's for good, which ended its replay (s); else None.
    """

    task: TouchTask
    compared: int
    differing: int
    median_counts: float
    worst_counts: int
    lifted_s: float | None
    parted_s: float | None

    @property
    def drove(self) -> bool:
        """The recorded targets are this task's own, mostly and to the end, and it came to a contact of its scan."""
        came_to_scan = self.task.shape is not None and bool(self.task.shape.samples)
        return came_to_scan and self.parted_s is None and self.median_counts <= OWN_COUNTS


def controller_cycles(cycles: Iterable[LogCycle]) -> Iterator[LogCycle]:
    """The cycles in which a cell steps its controller: from the one after all drives are in operation enabled until
    one leaves it, or the master asks for anything else."""
    started = False
    for cycle in cycles:
        if not started:
            started = cycle.measurement.q is not None and cycle.measurement.enabled
        elif cycle.measurement.enabled and cycle.enabled_by_master:
            yield cycle
        else:
            return


def replay_task(plan: Plan, cycles: Iterable[LogCycle]) -> TaskReplay:
    """Step the scene's task through recorded cycles and hold its targets against the recorded ones.

    It ends early where the targets are clearly another controller's.
    """
    task = make_task(plan)
    assert isinstance(task, TouchTask)
    way_back = LoggedWayBack(plan)
    comparison = _Comparison(plan)
    for cycle in way_back.cycles_before(controller_cycles(cycles)):
        if max(cycle.measurement.q_age, default=0) >= comparison.hold_cycles:
            continue  # a late drive: the cell held, and asked its controller nothing
        command = task.step(cycle.measurement)
        comparison.add(cycle, command.q_target)
        if command.done or command.stop_reason is not None or comparison.parted_s is not None:
            break
    else:
        for cycle, q in way_back.steps:
            comparison.add(cycle, q)
    return comparison.result(task, way_back.begun_s)


class _Comparison:
    """Recorded targets beside those of the replay."""

    def __init__(self, plan: Plan) -> None:
        assert plan.setup.arm is not None
        self.hold_cycles = limits_of(plan).hold_cycles
        self.parted_s: float | None = None
        self._model = plan.setup.arm.model
        self._patience = round(PARTED_S * 1e9 / plan.sync.period_ns)
        self._differences: list[int] = []
        self._away = 0

    def add(self, cycle: LogCycle, q: Vector | None) -> None:
        """One cycle, and the joint angles (6,), rad, that its drives should have been told."""
        if cycle.targets is None or q is None:
            return
        self._differences.append(worst_count(self._model, q, cycle.targets))
        self._away = self._away + 1 if self._differences[-1] > PARTED_COUNTS else 0
        if self._away > self._patience:
            self.parted_s = cycle.measurement.t_ns * 1e-9

    def result(self, task: TouchTask, lifted_s: float | None) -> TaskReplay:
        """What came of it."""
        differences = self._differences
        return TaskReplay(
            task,
            compared=len(differences),
            differing=sum(d > TARGET_TOLERANCE for d in differences),
            median_counts=float(np.median(differences)) if differences else math.inf,
            worst_counts=max(differences, default=0),
            lifted_s=lifted_s,
            parted_s=self.parted_s,
        )


def replay_contacts(plan: Plan, cycles: Iterable[LogCycle]) -> tuple[ShapeTracker, int]:
    """Feed every contact of a log to the scene's estimator, whoever made it: force above the touch threshold.

    Returns:
        The tracker; and how many contacts could not be placed for want of the joints of their instant.
    """
    assert isinstance(plan.setup.task, Touch)
    sensing = make_sensing(plan.setup.task)
    tracker = make_shape_tracker(plan.setup)
    assert tracker is not None
    for cycle in cycles:
        measurement = cycle.measurement
        patch = sensing.step(measurement)
        if patch is None or measurement.tactile is None or patch.force <= TOUCH_FORCE:
            continue
        contact = sensing.contact(measurement.tactile, patch)
        if contact is None:
            continue
        tracker.add(contact)
        estimate = tracker.answer_at_once(measurement.t_ns * 1e-9)
        if estimate is not None and bool(np.all(estimate.observed)):
            sensing.set_kappa(np.asarray(estimate.kappa))
    return tracker, sensing.dropped
