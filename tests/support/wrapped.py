"""A controller round another one: everything is passed on, for tests that change one thing."""

from __future__ import annotations

from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.tasks.task import Task, TaskRecord, record_of


class Wrapped(Task):
    """Passes everything on to a controller.

    Args:
        task: the controller inside.
    """

    def __init__(self, task: Controller) -> None:
        self.task = task

    def step(self, measurement: Measurement) -> Command:
        return self.task.step(measurement)

    def inspect(self, q):
        return self.task.inspect(q)

    def update(self) -> None:
        self.task.update()

    @property
    def retreats_itself(self) -> bool:
        return self.task.retreats_itself

    @property
    def trail(self):
        return self.task.trail

    def retreat(self, reason: str) -> None:
        self.task.retreat(reason)

    @property
    def restarts(self) -> int:
        return self.task.restarts

    def record(self) -> TaskRecord:
        return record_of(self.task)
