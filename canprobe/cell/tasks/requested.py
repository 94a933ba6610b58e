"""A task that a bridge starts, stops and sets while it runs; its requests were checked before.

A new target force or speed is approached at a bounded rate: no request makes a step.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from canprobe.cell.master.controller import Command, Controller, Measurement, WrappingController
from canprobe.cell.master.trail import TakenWay
from canprobe.cell.planning.model import Plan
from canprobe.cell.tasks.probing import ProbingTask
from canprobe.cell.tasks.task import MotionTime
from canprobe.cell.tasks.touch import TouchTask, target_column, towards
from canprobe.cell.tasks.trajectory import Trajectory
from canprobe.errors import UsageError
from canprobe.mechanics.touch.servo import TARGET_RATES
from canprobe.mechanics.types import Floats


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_way(value: object) -> bool:
    return isinstance(value, dict) and value.keys() == {"points", "velocities"}


_VALUES: dict[str, Callable[[object], bool]] = {
    "start": lambda value: value is None,
    "stop": lambda value: value is None,
    "resume": lambda value: value is None,
    "target_force_n": _is_number,
    "speed_m_s": _is_number,
    "trajectory": _is_way,
}
"""The kinds of requests, and whether something can be the value of one."""


@dataclass(frozen=True, slots=True)
class Request:
    """A request of another tool to a running task; other kinds and values are refused.

    Args:
        kind: start, stop, resume, target_force_n, speed_m_s or trajectory.
        value: None for start, stop and resume; N or m/s, finite; the arguments `points` and `velocities` of a
            `Trajectory`.

    Raises:
        UsageError: the kind is unknown, or the value has another type.
    """

    kind: str
    value: Any = None

    def __post_init__(self) -> None:
        fits = _VALUES.get(self.kind)
        if fits is None or not fits(self.value):
            kinds = ", ".join(_VALUES)
            got = f"{self.kind!r} with the value {self.value!r}"
            raise UsageError(f"request: expected one of {kinds}, each with a value of its type, got {got}")


class RequestedTask(WrappingController):
    """Steps a task, and lets requests change it.

    Args:
        task: the task; None holds still until a `start`.
        make: makes a new task at every `start`; None where the task runs once, from the beginning.
        requests: queues in which requests arrive.
        period_s: period of the cycle.
        plan: plan of a cell whose arm follows trajectories on request; None: none is requested.
    """

    def __init__(
        self,
        task: Controller | None,
        make: Callable[[], Controller] | None,
        requests: Sequence[deque[Request]],
        period_s: float,
        plan: Plan | None = None,
    ) -> None:
        self.inner = task
        self._plan = plan
        self._period_s = period_s
        self._time = MotionTime(round(1e9 * period_s))
        self._step_s = period_s  # between the last two targets: a late cycle has several periods
        self._targets: list[Floats] = []  # the last two: what takes over goes on at their speed
        self._make = make
        self._requests = requests
        self._asked: dict[str, float] = {}
        self._stopping = False

    def step(self, measurement: Measurement) -> Command:
        """Take the requests, and give the command of a cycle."""
        for queue in self._requests:
            while queue:
                request = queue.popleft()
                if request.kind == "trajectory":
                    self._follow(measurement, **request.value)
                else:
                    self._take(request)
        self._step_s = 1e-9 * self._time.step(measurement.t_ns)
        if self.inner is None:
            return Command()
        columns = self._approach(self.inner) if isinstance(self.inner, TouchTask) else {}
        command = self.inner.step(measurement)
        if columns:
            command = replace(command, columns={**command.columns, **columns})
        if self._stopping and not isinstance(self.inner, ProbingTask):
            command = replace(command, done=True)
        if self._plan is not None and command.q_target is not None:
            self._targets = [*self._targets[-1:], command.q_target]
        if command.done and self._make is not None:
            self.inner, self._stopping, self._targets = None, False, []
            return replace(command, done=False)
        return command

    def update(self) -> None:
        if self.inner is not None:
            self.inner.update()

    @property
    def resumable(self) -> bool:  # type: ignore[override]
        """Whether there is something to do after a loss: the next task that is asked for, or what goes on itself."""
        return self.inner is None or self._make is not None or self.inner.resumable

    def asks_to_go_on(self) -> bool:
        """Whether a request asks for motion after a loss; the others are refused meanwhile: they came too early."""
        kinds = [request.kind for queue in self._requests for request in queue]
        for queue in self._requests:
            queue.clear()
        return "resume" in kinds

    def go_on(self, measurement: Measurement) -> None:
        """Wait for the next start, or let the task go on that can."""
        self._targets, self._stopping = [], False
        self._time = MotionTime(round(1e9 * self._period_s))
        if self.inner is not None and not self.inner.resumable:
            self.inner = None
        elif self.inner is not None:
            self.inner.go_on(measurement)

    @property
    def trail(self) -> TakenWay | None:
        return None if self.inner is None else self.inner.trail

    def _take(self, request: Request) -> None:
        if request.kind == "stop":
            if isinstance(self.inner, ProbingTask):
                self.inner.stop()
            elif self._plan is not None and len(self._targets) == 2:
                self.inner = Trajectory.braking(self._plan, *self._motion())
                return
            self._stopping = self.inner is not None
        elif request.kind == "start":
            if self.inner is None and self._make is not None:
                self.inner = self._make()
        else:
            self._asked[request.kind] = request.value

    def _follow(self, measurement: Measurement, **way: Any) -> None:
        """Leave what the arm does for a trajectory, at the speed that it has; the bridge has checked the way."""
        assert self._plan is not None and measurement.q is not None
        trajectory = Trajectory(self._plan, **way)
        trajectory.lead(*(self._motion() if len(self._targets) == 2 else (measurement.q, None)))
        self.inner, self._stopping = trajectory, False

    def _motion(self) -> tuple[Floats, Floats]:
        """Position and speed (n,) in this cycle, as the last two targets lead on."""
        before, last = self._targets
        qd = (last - before) / self._step_s
        return last + qd * self._period_s, qd

    def _approach(self, task: TouchTask) -> dict[str, float]:
        """Move the task's targets towards what was asked for; what they are now, once anything was asked for.

        A request takes the place of a table.
        """
        for kind, wanted in self._asked.items():
            task.tables.pop(kind, None)
            task.targets[kind] = towards(wanted, task.targets[kind], TARGET_RATES[kind] * self._period_s)
        return {target_column(kind): task.targets[kind] for kind in self._asked}
