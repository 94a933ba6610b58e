"""Plan → the numbers behind the supervision: the scene's limits become SI here, once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from canprobe.cell.measurement import TactileSample
from canprobe.cell.supervision import Limits, Vector
from canprobe.planning.model import HEARTBEAT_CONSUMED_MS, HEARTBEAT_PRODUCED_MS, Plan
from canprobe.robot.kinematics import forward
from canprobe.robot.puma260 import MODELS, PumaModel
from canprobe.scene import TOUCH_KINDS, LimitSettings, ProbeSettings, Scene
from canprobe.scene_geometry import T_flange_probe

if TYPE_CHECKING:
    from canprobe.touch.patch import Patch

TACTILE_TIMEOUT_PERIODS = 6
_ROUNDING = 1e-9
_MS = 1_000_000


def limits_of(plan: Plan) -> Limits:
    """What the cell of a plan must not go beyond, and when it notices."""
    scene = plan.scene
    ratio = scene.cycle.rate_hz / scene.sensor.rate_hz if scene.sensor is not None else 1.0
    limits = Limits(
        period_ns=plan.sync.period_ns,
        heartbeat_produced_ns=HEARTBEAT_PRODUCED_MS * _MS,
        heartbeat_timeout_ns=HEARTBEAT_CONSUMED_MS * _MS,
        tactile_cycles=round(ratio),
        tactile_timeout=math.ceil(TACTILE_TIMEOUT_PERIODS * ratio),
        force_max=scene.limits.force_max_n,
        preload_max=scene.limits.preload_max_n if scene.task.kind in TOUCH_KINDS else math.inf,
        regain=scene.task.regain_mm * 1e-3,
        late_share=scene.limits.late_cycles_max_percent / 100,
    )
    return limits if scene.arm is None else _of_arm(limits, scene, MODELS[scene.arm.model])


def _of_arm(limits: Limits, scene: Scene, model: PumaModel) -> Limits:
    assert scene.arm is not None
    margin = math.radians(scene.limits.joint_margin_deg) - _ROUNDING
    return replace(
        limits,
        missed_cycles=scene.arm.missed_syncs,
        joint_low=model.q_min + margin,
        joint_high=model.q_max - margin,
        joint_speed=model.qd_max * scene.limits.joint_speed_share,
        count=np.abs(model.joints_per_count).sum(axis=1),
        workspace=workspace_of(scene.limits),
        T_base_tip_of=_T_base_tip_of(model, scene.probe or ProbeSettings()),
    )


def _T_base_tip_of(model: PumaModel, probe: ProbeSettings) -> Callable[[Vector], Vector]:
    T_flange_tip = T_flange_probe(probe).copy()
    T_flange_tip[:3, 3] += probe.radius_mm * 1e-3 * T_flange_tip[:3, 2]
    return lambda q: forward(model, q) @ T_flange_tip


def workspace_of(limits: LimitSettings) -> Vector | None:
    """The box (2, 3) of the probe's tip, m; a side that the scene leaves open is infinite; None without any."""
    low, high = limits.workspace_min_mm, limits.workspace_max_mm
    if low is None and high is None:
        return None
    return np.array([low or (-math.inf,) * 3, high or (math.inf,) * 3]) * 1e-3


def patch_from(scene: Scene) -> Callable[[TactileSample], Patch] | None:
    """The patch of a tactile sample of the scene's sensor; None without one."""
    if scene.sensor is None:
        return None
    from canprobe.cell.tasks.calibration import array_calibration
    from canprobe.cell.tasks.sensing import patch_of

    radius = {} if scene.probe is None else {"radius_m": scene.probe.radius_mm * 1e-3}
    calibration = array_calibration(scene.sensor.full_scale_kpa * 1e3, **radius)
    return lambda sample: patch_of(sample, calibration)
