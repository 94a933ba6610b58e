"""Plan and port → cell; plan → the controller of its task. Only what the scene needs is made."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from canprobe.bus.clock import VirtualClock
from canprobe.bus.port import Port
from canprobe.cell.bringup import BringUpTimes
from canprobe.cell.cell import Cell
from canprobe.cell.configuration import make_setups
from canprobe.cell.cycle import CycleSettings
from canprobe.cell.drives import DriveAxis, DriveGroup
from canprobe.cell.limits import limits_of, patch_from
from canprobe.cell.measurement import Controller
from canprobe.cell.observe import Observers
from canprobe.cell.tactile import TactileReceiver
from canprobe.planning.model import (
    HEARTBEAT_PRODUCED_MS,
    MASTER_NODE_ID,
    Plan,
)
from canprobe.protocol.tactile import FrameAssembler, TactileMode
from canprobe.scene_setup import BringUp, Calibrate, Free, Listen

if TYPE_CHECKING:
    from canprobe.cell.lift_off import LiftOff

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
    from canprobe.cell.lift_off import LiftOff

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


def make_task(plan: Plan) -> Controller:
    """The controller of the plan's task; what the task does not need is not even imported."""
    period_s, task = plan.sync.period_ns * 1e-9, plan.setup.task
    if isinstance(task, Free):
        from canprobe.cell.tasks.untouched import FreeTask

        return FreeTask(task.swing, task.period_s, task.duration_s, period_s)
    if isinstance(task, Listen):
        from canprobe.cell.tasks.calibration import array_calibration
        from canprobe.cell.tasks.untouched import ListenTask

        return ListenTask(array_calibration(task.array.full_scale), task.duration_s, period_s, limits_of(plan))
    from canprobe.cell.tasks.build import make_calibrate_task, make_touch_task

    return make_calibrate_task(plan, task) if isinstance(task, Calibrate) else make_touch_task(plan, task)
