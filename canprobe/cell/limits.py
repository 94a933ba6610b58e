"""Plan → the numbers behind the supervision."""

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
from canprobe.robot.puma260 import PumaModel
from canprobe.scene_setup import Arm, Probe, Setup, Touch

if TYPE_CHECKING:
    from canprobe.touch.patch import Patch

TACTILE_TIMEOUT_PERIODS = 6
_ROUNDING = 1e-9
_MS = 1_000_000


def limits_of(plan: Plan) -> Limits:
    """What the cell of a plan must not go beyond, and when it notices."""
    setup = plan.setup
    ratio = setup.rate_hz / setup.array.rate_hz if setup.array is not None else 1.0
    scan = setup.task.scan if isinstance(setup.task, Touch) else None
    limits = Limits(
        period_ns=plan.sync.period_ns,
        heartbeat_produced_ns=HEARTBEAT_PRODUCED_MS * _MS,
        heartbeat_timeout_ns=HEARTBEAT_CONSUMED_MS * _MS,
        tactile_cycles=round(ratio),
        tactile_timeout=math.ceil(TACTILE_TIMEOUT_PERIODS * ratio),
        force_max=setup.limits.force_max,
        preload_max=setup.limits.preload_max if setup.touch is not None else math.inf,
        regain=scan.regain if scan is not None else 0.0,
        late_share=setup.limits.late_share,
    )
    return limits if setup.arm is None else _of_arm(limits, setup, setup.arm)


def _of_arm(limits: Limits, setup: Setup, arm: Arm) -> Limits:
    model, margin = arm.model, setup.limits.joint_margin - _ROUNDING
    return replace(
        limits,
        missed_cycles=arm.missed_syncs,
        joint_low=model.q_min + margin,
        joint_high=model.q_max - margin,
        joint_speed=model.qd_max * setup.limits.speed_share,
        count=np.abs(model.joints_per_count).sum(axis=1),
        workspace=setup.limits.workspace,
        T_base_tip_of=_T_base_tip_of(model, setup.probe),
    )


def _T_base_tip_of(model: PumaModel, probe: Probe) -> Callable[[Vector], Vector]:
    T_flange_tip = probe.T_flange_probe.copy()
    T_flange_tip[:3, 3] += probe.radius * T_flange_tip[:3, 2]
    return lambda q: forward(model, q) @ T_flange_tip


def patch_from(setup: Setup) -> Callable[[TactileSample], Patch] | None:
    """The patch of a sample of the setup's array; None without one."""
    if setup.array is None:
        return None
    from canprobe.cell.tasks.calibration import array_calibration
    from canprobe.cell.tasks.sensing import patch_of

    calibration = array_calibration(setup.array.full_scale, setup.probe.radius)
    return lambda sample: patch_of(sample, calibration)
