"""Plan → the controller of its task, and its estimators."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from canprobe.cell.master.controller import Controller
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.plugins import find_plugin
from canprobe.cell.scene.setup import Array, Calibrate, Free, Probe, Scan, Setup, Touch
from canprobe.cell.tasks.shape import OfferedEstimator, RenewedEstimator, ShapeRecord, ShapeTracker, replay_samples
from canprobe.fieldbus.protocol.tactile import DEFAULT_WINDOW

if TYPE_CHECKING:
    from canprobe.cell.tasks.sensing import ContactSensing
    from canprobe.mechanics.touch import ArrayCalibration, ContactSample, Correlation, Estimator, ImageModel, SurfaceMap
    from canprobe.mechanics.touch.online.estimator import AnswerStage


HEIGHT_CORRELATION = (2e-3, 0.2)
"""Correlation length of the heights of contacts along the path, m, and the share of their variance that is correlated,
over 90 random scenes: the depth follows the force of some images. Heights scatter by 10 µm at a depth of 0.4 mm and of
1 mm alike. Why not wider and more correlated, as they are where curvature jumps: heights then count for nothing, and
the normal is a third less exact on a soft layer."""
NORMAL_CORRELATION = 0.05
"""Share of the variance of the normals, beside their slow errors, that is correlated over the same length: a pad that
follows the normal moves to and fro by some tens of micrometres, and within its hysteresis the centroid shows 20 to 80 %
of that. Set on 90 scenes of a development draw: without it cubic terms are found in this error on planes."""
SIGMA_NORMAL_RAD = 0.3e-3
"""Error of a normal that does not come from its centroid: joint counts displace the probe by 11 µm, times 28 1/m."""
SIGMA_STIFFNESS = 0.6
"""Standard deviation of the logarithm of the layer's stiffness before any touch."""
REFINED_METHODS = ("recursive", "ml")
"""Estimators whose answers are refined by the stages of `online`; the others are as published."""


def make_sensing(task: Touch | Calibrate) -> ContactSensing:
    """The contact sensing of a task, for its arm, probe and array."""
    from canprobe.cell.tasks.sensing import ContactSensing

    moments = isinstance(task, Touch) and _uses_patch(task)
    return ContactSensing(task.arm, task.probe, task.array, task.force, moments=moments, carrier=task.carrier)


def centroid_coupling(probe: Probe) -> float:
    """`Noise.coupling` of contacts that the array on this probe measures, 1/m."""
    return 1.0 / probe.radius


def contact_correlation(array: Array) -> Correlation:
    """Correlation of the noise of an array's contacts along their path, and over the pad."""
    from canprobe.mechanics.touch import Correlation  # only where a shape is asked for

    length, share = HEIGHT_CORRELATION
    return Correlation(length, NORMAL_CORRELATION, share, array.calibration.noise.slow_way)


def make_shape_estimator(task: Touch, method: str) -> Estimator:
    """An estimator by its name, with the settings of a scan."""
    from canprobe.mechanics.touch import OnlineEstimator, make_estimator  # only where a shape is asked for
    from canprobe.mechanics.touch.estimate.fit import METHODS

    assert task.shape is not None and task.scan is not None
    memory = task.shape.memory
    slowest = task.tables["speed_m_s"].lowest if "speed_m_s" in task.tables else task.scan.speed
    window = max(8, round(memory / slowest * task.array.rate_hz))
    settings: dict[str, Any] = {
        "sigma_point": _typical_sigma(task),
        "sigma_normal": SIGMA_NORMAL_RAD,
        "memory_m": memory,
        "window": window,
        "correlation": contact_correlation(task.array),
        "coupling": centroid_coupling(task.probe),
    }
    if method not in METHODS and (plugin := find_plugin("estimator", method)) is not None:
        return RenewedEstimator(lambda: OfferedEstimator(plugin, settings))
    motion = make_estimator(method, **settings)
    if method not in REFINED_METHODS:
        return motion
    return OnlineEstimator(motion, *_stages(task, memory, task.scan))


def _stages(task: Touch, memory: float, scan: Scan) -> Iterator[AnswerStage]:
    """The stages of a task's answers, in order."""
    from canprobe.mechanics.touch import MapFusion, NoiseLevel, PatchCurvature, PatchFusion, SystematicErrors
    from canprobe.mechanics.touch.online.beyond import beyond_factor

    assert task.shape is not None
    if _uses_patch(task):
        others = [_image_model(task, other) for other in task.array.calibration.others_of_make()]
        yield PatchFusion(PatchCurvature(_image_model(task), SIGMA_STIFFNESS, others), memory)
    yield NoiseLevel(memory)
    wider = beyond_factor(task.array.calibration.force.beyond(task.force), scan.speed)
    yield SystematicErrors.of_scan(memory, scan.rolling_share, task.probe.position_sd, wider)
    if task.shape.revisit:
        yield MapFusion(make_surface_map(task), memory)


def _typical_sigma(task: Touch) -> float:
    """Standard deviation of a contact at the lowest wanted force on a plane, m, for contacts that state none."""
    from canprobe.mechanics.touch import indentation_from_force

    probe = task.probe
    depth = indentation_from_force(task.least_force, probe.stiffness, probe.radius, (0.0, 0.0))
    return task.array.calibration.noise.lateral(task.array.pad.lightness(probe.stiffness * float(depth)))


def _image_model(task: Touch, calibration: ArrayCalibration | None = None) -> ImageModel:
    """The image model of a task's array, by its calibration or another one."""
    from canprobe.mechanics.touch import make_image_model, make_patch_calibration

    array = task.array
    patch = make_patch_calibration(array.calibration, array.pad)
    windowed = array.mode == "window" and int(array.window) <= DEFAULT_WINDOW
    seen = int(array.window) if windowed else None
    return make_image_model(calibration or array.calibration, patch, seen=seen)


def make_surface_map(task: Touch) -> SurfaceMap:
    """An empty map for the contacts of a task's pad."""
    from canprobe.mechanics.touch import PAD_NOISE, PadLayer, SurfaceMap  # only where a shape is asked for

    noise = replace(PAD_NOISE, place=task.probe.place_sd)
    return SurfaceMap(PadLayer(task.probe.radius, task.probe.stiffness), noise, _image_model(task))


def _uses_patch(task: Touch) -> bool:
    """Whether images are asked for curvature: features carry none."""
    return task.shape is not None and task.shape.patch and task.array.mode != "features"


def make_shape_tracker(setup: Setup, *, with_map: bool = True) -> ShapeTracker | None:
    """The estimator in the loop, and the map of its contacts; None where the setup estimates no shape."""
    task = setup.task
    if not isinstance(task, Touch) or task.shape is None:
        return None
    samples = max(1, round(task.shape.every_s * task.array.rate_hz))
    surface_map = make_surface_map(task) if with_map and setup.outputs.surface_map else None
    return ShapeTracker(make_shape_estimator(task, task.shape.method), samples, surface_map)


def estimates_of(
    setup: Setup,
    online: list[ShapeRecord],
    settled: Sequence[ContactSample],
    methods: Iterable[str],
    most: int | None = None,
) -> dict[str, list[ShapeRecord]]:
    """The answers of methods on the contacts of a scan.

    Args:
        setup: setup of the scan.
        online: answers of the estimator in the loop, which are not computed again.
        settled: contacts of the scan, as `ShapeTracker.settled` places them.
        methods: names of estimators.
        most: number of answers of a method beyond which they are further apart than 0.1 s; None for no such number.
    """
    task = setup.task
    assert isinstance(task, Touch) and task.shape is not None
    every = max(1, round(0.1 * task.array.rate_hz))
    if most is not None:
        every = max(every, math.ceil(len(settled) / most))
    return {
        method: online
        if method == task.shape.method
        else replay_samples(make_shape_estimator(task, method), settled, every)
        for method in dict.fromkeys(methods)
    }


def make_task(plan: Plan) -> Controller:
    """The controller of the plan's task; what the task does not need is not even imported."""
    period_s, task = plan.sync.period_ns * 1e-9, plan.setup.task
    if isinstance(task, Touch):
        from canprobe.cell.tasks.touch import TouchTask
        from canprobe.mechanics.touch import CalibrationCheck
        from canprobe.mechanics.touch.strategies import Rectangle

        array = task.array
        check = CalibrationCheck.of(array.calibration, array.pad, images=array.mode != "features")
        parts = plan, task, make_sensing(task), make_shape_tracker(plan.setup), check
        if task.scan is None or not isinstance(task.scan.strategy, Rectangle):
            return TouchTask(*parts)
        from canprobe.cell.tasks.explore import ExploreTask

        return ExploreTask(*parts)
    if isinstance(task, Calibrate):
        from canprobe.cell.tasks.calibrate import CalibrateTask

        return CalibrateTask(plan, task, make_sensing(task))
    if isinstance(task, Free):
        from canprobe.cell.tasks.free_and_listen import FreeTask

        return FreeTask(task.swing, task.period_s, task.duration_s, period_s)
    from canprobe.cell.tasks.free_and_listen import ListenTask
    from canprobe.mechanics.touch import make_patch_calibration

    patch = make_patch_calibration(task.array.calibration, task.array.pad)
    return ListenTask(patch, task.duration_s, period_s)
