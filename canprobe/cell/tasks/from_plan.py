"""Plan → the controller of its task, its estimators, and a task that others start, stop and set while it runs."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.setup import Calibrate, Free, Probe, Setup, Touch
from canprobe.cell.tasks.probing import ProbingTask
from canprobe.cell.tasks.sensing import ContactSensing
from canprobe.cell.tasks.shape import ShapeRecord, ShapeTracker, replay_samples
from canprobe.cell.tasks.task import MotionTime
from canprobe.cell.tasks.touch import TouchTask
from canprobe.errors import UsageError
from canprobe.fieldbus.protocol.tactile import WINDOW
from canprobe.mechanics.robot.chain import Array as Vector
from canprobe.mechanics.touch.contact import indentation_from_force
from canprobe.mechanics.touch.patch.array_calibration import CentroidErrors
from canprobe.mechanics.touch.patch.image_model import make_image_model, make_patch_calibration
from canprobe.mechanics.touch.patch.moments import MomentImage

if TYPE_CHECKING:
    from canprobe.mechanics.touch.estimate.noise import Correlation
    from canprobe.mechanics.touch.estimate.online import Estimator


# Plan → the tasks that touch.

ALIKE = (2e-3, 0.3)
"""Path of the contact (m) along which a share of the centroids' variance is alike, over 87 random scenes. That of a
calibration is a way over the pad, of which a pad that follows the normal goes a twentieth."""
SCANNING = 1.6
"""Error of a centroid in a scan over that of a calibration's touches, which roll over 1 mm. Over 87 random scenes at
100 kPa it is 1.25 (RMS), but not Gaussian: at 1.35 one scan of the cylinder in ten raises a false alarm of another
surface, at 1.6 none, and saddle, torus and wave err less."""
SIGMA_NORMAL_RAD = 0.3e-3
"""Of what turns no centroid: joint counts displace the probe by 11 µm, and the surface bends by 28 1/m of it."""
SIGMA_STIFFNESS = 0.6
"""Of the logarithm of the layer's stiffness, before any touch."""
SCALE, SCALE_ROLLING = 4e-3, 0.08
"""Relative error of curvature that no path averages, and what a probe that keeps its orientation adds to it: creep
shows the ways of the contact over the pad too short, and the rolling share is their part of what bends the normal."""
WITH_PATCH = ("recursive", "ml")
"""Estimators whose answers the patch completes and whose regions follow changes; the others stay as they were."""


def make_sensing(task: Touch | Calibrate) -> ContactSensing:
    """Contacts from measurements, as the task's arm, probe and array give them."""
    calibration = make_patch_calibration(task.array.calibration, task.array.pad)
    return ContactSensing(
        task.arm.model,
        task.probe.T_flange_probe,
        calibration,
        task.probe.radius,
        task.probe.stiffness,
        noise=_centroid_errors(task),
        moment_image=MomentImage(calibration) if isinstance(task, Touch) and _uses_patch(task) else None,
        lag=task.array.calibration.centroid.lag,
    )


def _centroid_errors(task: Touch | Calibrate) -> CentroidErrors:
    calibrated = task.array.calibration.centroid
    return replace(calibrated, scale=SCANNING * calibrated.scale)


def centroid_coupling(probe: Probe) -> float:
    """`Noise.coupling` of contacts that the array on this probe feels, 1/m."""
    return 1.0 / probe.radius


def centroid_correlation() -> Correlation:
    """Of the noise of contacts along their path."""
    from canprobe.mechanics.touch.estimate.noise import Correlation  # only where a shape is asked for

    return Correlation(*ALIKE)


def make_shape_estimator(task: Touch, method: str) -> Estimator:
    """An estimator as a scan's setup has it, by name."""
    from canprobe.mechanics.touch.estimate.fit import make_estimator  # only where a shape is asked for

    assert task.shape is not None and task.scan is not None
    memory = task.shape.memory
    window = max(8, round(memory / task.scan.speed * task.array.rate_hz))
    estimator = make_estimator(
        method,
        sigma_point=_typical_sigma(task),
        sigma_normal=SIGMA_NORMAL_RAD,
        memory_m=memory,
        window=window,
        correlation=centroid_correlation(),
        coupling=centroid_coupling(task.probe),
    )
    if method not in WITH_PATCH:
        return estimator
    from canprobe.mechanics.touch.estimate.online import FollowingEstimator

    scale = SCALE + SCALE_ROLLING * task.scan.rolling_share
    return FollowingEstimator(_with_patch(task, estimator, memory) if _uses_patch(task) else estimator, memory, scale)


def _typical_sigma(task: Touch) -> float:
    """Standard deviation of a contact at the wanted force on a plane, m: of what has none of its own."""
    probe = task.probe
    depth = indentation_from_force(task.force, probe.stiffness, probe.radius, (0.0, 0.0))
    level_pa = MomentImage(make_patch_calibration(task.array.calibration, task.array.pad)).level_pa
    return _centroid_errors(task).sigma(level_pa / (probe.stiffness * float(depth)))


def _with_patch(task: Touch, estimator: Estimator, memory: float) -> Estimator:
    """The estimator with the contact patch as its second sensor."""
    from canprobe.mechanics.touch.patch.curvature import PatchCurvature, PatchedEstimator

    array = task.array
    patch = make_patch_calibration(array.calibration, array.pad)
    windowed = array.mode == "window" and int(array.window) <= WINDOW
    model = make_image_model(array.calibration, patch, seen=int(array.window) if windowed else None)
    return PatchedEstimator(estimator, PatchCurvature(model, SIGMA_STIFFNESS), memory)


def _uses_patch(task: Touch) -> bool:
    """Whether images are asked for curvature: features carry none."""
    return task.shape is not None and task.shape.patch and task.array.mode != "features"


def make_shape_tracker(setup: Setup) -> ShapeTracker | None:
    """The estimator of a setup that asks for a shape, None of one that does not."""
    task = setup.task
    if not isinstance(task, Touch) or task.shape is None:
        return None
    samples = max(1, round(task.shape.every_s * task.array.rate_hz))
    return ShapeTracker(make_shape_estimator(task, task.shape.method), samples)


def estimates_of(setup: Setup, tracker: ShapeTracker, methods: Iterable[str]) -> dict[str, list[ShapeRecord]]:
    """What the tracker's estimator said, where it is one of ``methods``, and the others on the same contacts."""
    task = setup.task
    assert isinstance(task, Touch) and task.shape is not None
    every = max(1, round(0.1 * task.array.rate_hz))
    return {
        method: tracker.records
        if method == task.shape.method
        else replay_samples(make_shape_estimator(task, method), tracker.samples, every)
        for method in dict.fromkeys(methods)
    }


def make_task(plan: Plan) -> Controller:
    """The controller of the plan's task; what the task does not need is not even imported."""
    period_s, task = plan.sync.period_ns * 1e-9, plan.setup.task
    if isinstance(task, Touch):
        return TouchTask(plan, task, make_sensing(task), make_shape_tracker(plan.setup))
    if isinstance(task, Calibrate):
        from canprobe.cell.tasks.calibrate import CalibrateTask

        return CalibrateTask(plan, task, make_sensing(task))
    if isinstance(task, Free):
        from canprobe.cell.tasks.free_and_listen import FreeTask

        return FreeTask(task.swing, task.period_s, task.duration_s, period_s)
    from canprobe.cell.tasks.free_and_listen import ListenTask

    patch = make_patch_calibration(task.array.calibration, task.array.pad)
    return ListenTask(patch, task.duration_s, period_s)


# A task that a bridge starts, stops and sets while it runs; its requests were checked before.
#
# A new target force or speed is approached at a bounded rate: no request makes a step.


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _is_way(value: object) -> bool:
    return isinstance(value, dict) and value.keys() == {"points", "velocities"}


_VALUES: dict[str, Callable[[object], bool]] = {
    "start": lambda value: value is None,
    "stop": lambda value: value is None,
    "target_force_n": _is_number,
    "speed_m_s": _is_number,
    "trajectory": _is_way,
}
"""The kinds of requests, and whether something can be the value of one."""


@dataclass(frozen=True, slots=True)
class Request:
    """What another tool asks of a running task; it cannot be made of anything else.

    Args:
        kind: start, stop, target_force_n, speed_m_s or trajectory.
        value: None for start and stop; N or m/s, finite; the arguments `points` and `velocities` of a `Trajectory`.

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


FORCE_RATE = 2.0
"""N/s."""
SPEED_RATE = 0.1
"""m/s²."""


class RequestedTask(Controller):
    """Steps a task, and lets requests change it.

    Args:
        task: the task; None holds still until a `start`.
        make: makes a new task at every `start`; None where the task runs once, from the beginning.
        requests: where requests arrive.
        period_s: of the cycle.
        plan: of an arm that follows trajectories on request; without, none is asked for.
    """

    def __init__(
        self,
        task: Controller | None,
        make: Callable[[], Controller] | None,
        requests: Sequence[deque[Request]],
        period_s: float,
        plan: Plan | None = None,
    ) -> None:
        self._task = task
        self._plan = plan
        self._period_s = period_s
        self._time = MotionTime(round(1e9 * period_s))
        self._step_s = period_s
        self._targets: list[Vector] = []
        self._make = make
        self._requests = requests
        self._steps = {"target_force_n": FORCE_RATE * period_s, "speed_m_s": SPEED_RATE * period_s}
        self._asked: dict[str, float] = {}
        self._stopping = False

    def step(self, measurement: Measurement) -> Command:
        """One cycle."""
        for queue in self._requests:
            while queue:
                request = queue.popleft()
                if request.kind == "trajectory":
                    self._follow(measurement, **request.value)
                else:
                    self._take(request)
        self._step_s = 1e-9 * self._time.step(measurement.t_ns)
        if self._task is None:
            return Command()
        columns = self._approach(self._task) if isinstance(self._task, TouchTask) else {}
        command = self._task.step(measurement)
        if columns:
            command = replace(command, columns={**command.columns, **columns})
        if self._stopping and not isinstance(self._task, ProbingTask):
            command = replace(command, done=True)
        if self._plan is not None and command.q_target is not None:
            self._targets = [*self._targets[-1:], command.q_target]
        if command.done and self._make is not None:
            self._task, self._stopping, self._targets = None, False, []
            return replace(command, done=False)
        return command

    def update(self) -> None:
        """What the task does once its commands are out."""
        if self._task is not None:
            self._task.update()

    @property
    def lets_go(self) -> bool:  # type: ignore[override]
        """As the task does."""
        return self._task is not None and self._task.lets_go

    def retreat(self, reason: str) -> None:
        """Ask the task to let go."""
        if self._task is not None:
            self._task.retreat(reason)

    @property
    def restarts(self) -> int:
        """Of the task's estimator."""
        return 0 if self._task is None else self._task.restarts

    def _take(self, request: Request) -> None:
        if request.kind == "stop":
            if isinstance(self._task, ProbingTask):
                self._task.stop()
            elif self._plan is not None and len(self._targets) == 2:
                from canprobe.cell.tasks.trajectory import Trajectory

                self._task = Trajectory.braking(self._plan, *self._motion())
                return
            self._stopping = self._task is not None
        elif request.kind == "start":
            if self._task is None and self._make is not None:
                self._task = self._make()
        else:
            self._asked[request.kind] = request.value

    def _follow(self, measurement: Measurement, **way: Any) -> None:
        """Leave what the arm does for a trajectory, at the speed that it has; the bridge has checked the way."""
        from canprobe.cell.tasks.trajectory import Trajectory

        assert self._plan is not None and measurement.q is not None
        trajectory = Trajectory(self._plan, **way)
        trajectory.lead(*(self._motion() if len(self._targets) == 2 else (measurement.q, None)))
        self._task, self._stopping = trajectory, False

    def _motion(self) -> tuple[Vector, Vector]:
        """Where the last two targets lead in this cycle: position and speed (n,)."""
        before, last = self._targets
        qd = (last - before) / self._step_s
        return last + qd * self._period_s, qd

    def _approach(self, task: TouchTask) -> dict[str, float]:
        """Move the task's targets towards what was asked for; what they are now, once anything was asked for."""
        for kind, wanted in self._asked.items():
            now, step = task.targets[kind], self._steps[kind]
            task.set_target(kind, now + min(max(wanted - now, -step), step))
        return {f"target_{kind.removeprefix('target_')}": task.targets[kind] for kind in self._asked}
