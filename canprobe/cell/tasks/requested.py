"""A task that somebody outside starts, stops and sets while it runs; what may be asked for was checked before.

A new target force or speed is approached at a bounded rate: no request makes a step.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from canprobe.cell.measurement import Command, Controller, Measurement
from canprobe.cell.tasks.touch import TouchTask

Requests = Sequence[deque[dict[str, Any]]]
"""Queues of `{"kind": "start" | "stop" | "target_force_n" | "speed_m_s", "value": float | None}`."""
FORCE_RATE = 2.0
"""N/s."""
SPEED_RATE = 0.1
"""m/s²."""


class RequestedTask:
    """Steps a task, and lets requests change it.

    Args:
        task: the task; None holds still until a `start`.
        make: makes a new task at every `start`; None where the task runs once, from the beginning.
        requests: where requests arrive.
        period_s: of the cycle.
    """

    def __init__(
        self, task: Controller | None, make: Callable[[], Controller] | None, requests: Requests, period_s: float
    ) -> None:
        self._task = task
        self._make = make
        self._requests = requests
        self._steps = {"target_force_n": FORCE_RATE * period_s, "speed_m_s": SPEED_RATE * period_s}
        self._asked: dict[str, float] = {}
        self._stopping = False

    def step(self, measurement: Measurement) -> Command:
        """One cycle."""
        for queue in self._requests:
            while queue:
                self._take(**queue.popleft())
        if self._task is None:
            return Command()
        columns = self._approach(self._task) if isinstance(self._task, TouchTask) else {}
        command = self._task.step(measurement)
        if columns:
            command = replace(command, columns={**command.columns, **columns})
        if self._stopping and not isinstance(self._task, TouchTask):
            command = replace(command, done=True)
        if command.done and self._make is not None:
            self._task, self._stopping = None, False
            return replace(command, done=False)
        return command

    def update(self) -> None:
        """What the task does once its commands are out."""
        if self._task is not None and (update := getattr(self._task, "update", None)) is not None:
            update()

    def _take(self, kind: str, value: float | None) -> None:
        if kind == "stop":
            self._stopping = self._task is not None
            if isinstance(self._task, TouchTask):
                self._task.stop()
        elif kind == "start":
            if self._task is None and self._make is not None:
                self._task = self._make()
        elif kind in self._steps and value is not None:
            self._asked[kind] = value

    def _approach(self, task: TouchTask) -> dict[str, float]:
        """Move the task's targets towards what was asked for; what they are now, once anything was asked for."""
        for kind, wanted in self._asked.items():
            now, step = task.targets[kind], self._steps[kind]
            task.set_target(kind, now + min(max(wanted - now, -step), step))
        return {f"target_{kind.removeprefix('target_')}": task.targets[kind] for kind in self._asked}
