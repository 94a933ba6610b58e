"""Plan and port → cell; plan → the limits behind its supervision. Only what the scene needs is made."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from canprobe.bus.port import Port, VirtualClock
from canprobe.cell.bringup import BringUpTimes
from canprobe.cell.cell import Cell
from canprobe.cell.configuration import make_setups
from canprobe.cell.controller import TactileSample
from canprobe.cell.cycle import CycleSettings, Observers
from canprobe.cell.drives import DriveAxis, DriveGroup, TactileReceiver
from canprobe.cell.supervision import Limits, Vector
from canprobe.planning.model import HEARTBEAT_CONSUMED_MS, HEARTBEAT_PRODUCED_MS, MASTER_NODE_ID, Plan
from canprobe.protocol.tactile import FrameAssembler, TactileMode
from canprobe.robot.chain import forward
from canprobe.robot.model import ArmModel
from canprobe.scene.setup import Arm, BringUp, Probe, Setup, Touch
from canprobe.touch.patch.image import Patch, PatchCalibration, compute_patch, patch_from_features

if TYPE_CHECKING:
    from canprobe.cell.supervisor import LiftOff


# Plan → the numbers behind the supervision.

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
    model = arm.model
    margin = (setup.limits.joint_margin - _ROUNDING) * model.radian
    return replace(
        limits,
        missed_cycles=arm.missed_syncs,
        joints=model.joints,
        joint_low=model.q_min + margin,
        joint_high=model.q_max - margin,
        joint_speed=model.qd_max * setup.limits.speed_share,
        count=np.abs(model.q_per_unit).sum(axis=1),
        workspace=setup.limits.workspace,
        T_base_tip_of=_T_base_tip_of(model, setup.probe),
    )


def _T_base_tip_of(model: ArmModel, probe: Probe) -> Callable[[Vector], Vector]:
    T_flange_tip = probe.T_flange_probe.copy()
    T_flange_tip[:3, 3] += probe.radius * T_flange_tip[:3, 2]
    return lambda q: forward(model.chain, q) @ T_flange_tip


def patch_from(setup: Setup) -> Callable[[TactileSample], Patch] | None:
    """The patch of a sample of the setup's array; None without one."""
    if setup.array is None:
        return None
    from canprobe.touch.patch.array_model import array_calibration

    calibration = array_calibration(setup.array.full_scale, setup.probe.radius)
    return lambda sample: patch_of(sample, calibration)


# Plan and port → cell; plan → the controller of its task. Only what the scene needs is made.

TACTILE_DEADLINE_CYCLES = 2
COMMAND_REPEAT_NS = 100_000_000


def make_cell(
    plan: Plan,
    port: Port,
    *,
    say: Callable[[str], None] = lambda _: None,
    times: BringUpTimes | None = None,
    log_failure: Callable[[], str | None] = lambda: None,
    observers: Observers | None = None,
    rows_kept: int | None = None,
    origin_ns: int = 0,
) -> Cell:
    """The cell of a plan on a port; nothing is sent before it is entered.

    Args:
        plan: of the scene.
        port: the bus.
        say: called with each step of bring-up and stop.
        times: time-outs of bring-up.
        log_failure: says why frames are no longer written down, None while they are.
        observers: called after each cycle.
        rows_kept: cycles whose row of the log is kept; None for all.
        origin_ns: time on the port's clock from which the run counts, as ``bus.log`` does.
    """
    settings = CycleSettings(
        period_ns=plan.sync.period_ns,
        sync_overflow=plan.sync.overflow,
        heartbeat_ns=HEARTBEAT_PRODUCED_MS * 1_000_000,
        master_id=MASTER_NODE_ID,
        looks_ns=plan.traffic.budget.looks_ns,
        on_arrival=not isinstance(port.clock, VirtualClock),
    )
    drives = make_drives(plan)
    return Cell(
        port,
        make_setups(plan),
        settings,
        drives=drives,
        tactile=make_tactile(plan),
        limits=limits_of(plan),
        patch_from=patch_from(plan.setup) if plan.setup.arm is not None else None,
        lift_from=_lift_from(plan, drives),
        say=say,
        times=times or _times(plan.setup.bring_up),
        log_failure=log_failure,
        observers=observers,
        rows_kept=rows_kept,
        origin_ns=origin_ns,
    )


def _lift_from(plan: Plan, drives: DriveGroup | None) -> Callable[[Callable[[int], bool]], LiftOff] | None:
    arm, flange_probe = plan.setup.arm, plan.setup.probe.T_flange_probe
    if arm is None or plan.setup.array is None or drives is None:
        return None
    from canprobe.cell.supervisor import LiftOff

    period_s = plan.sync.period_ns * 1e-9
    return lambda obeys: LiftOff(drives, arm.model, flange_probe, period_s, obeys)


def _times(settings: BringUp) -> BringUpTimes:
    return BringUpTimes(
        listen=settings.listen_s,
        boot_up=settings.boot_up_s,
        sdo=settings.sdo_s,
        start=settings.start_s,
        retries=settings.retries,
        store=settings.store,
    )


def make_drives(plan: Plan) -> DriveGroup | None:
    """The plan's drives as one; None without an arm."""
    arm = plan.setup.arm
    if arm is None:
        return None
    axes = tuple(
        DriveAxis(n, plan.pdos_of(n, "tpdo")[0].layout, tuple(pdo.layout for pdo in plan.pdos_of(n, "rpdo")))
        for n in arm.node_ids
    )
    repeat = max(1, COMMAND_REPEAT_NS // plan.sync.period_ns)
    return DriveGroup(axes, arm.model, repeat)


def make_tactile(plan: Plan, sync_overflow: int | None = None) -> TactileReceiver | None:
    """The receiver of the plan's sensor, None without one; ``sync_overflow`` where it is not the plan's."""
    sensor = plan.setup.array
    if sensor is None:
        return None
    pdos = plan.pdos_of(sensor.node_id, "tpdo")
    cob_ids = [pdo.cob_id for pdo in pdos]
    deadline = TACTILE_DEADLINE_CYCLES * plan.sync.period_ns
    sizes = [pdo.layout.length for pdo in pdos]
    mode = TactileMode[sensor.mode.upper()]
    assembler = FrameAssembler(cob_ids, mode, deadline, sizes, window=int(sensor.window))
    return TactileReceiver(assembler, cob_ids, sync_overflow or plan.sync.overflow)


def patch_of(sample: TactileSample, calibration: PatchCalibration) -> Patch:
    """Patch of a tactile frame, whatever the sensor's mode."""
    frame = sample.frame
    if frame.features is not None:
        return patch_from_features(frame.features, calibration)
    return compute_patch(frame.taxels, calibration, window=frame.window)
