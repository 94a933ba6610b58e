"""The table of conditions; see `canprobe.cell.supervision` for what its columns mean. Also as the README prints it."""

from __future__ import annotations

from collections.abc import Callable

from canprobe.cell import supervision as checks
from canprobe.cell.supervision import Condition, Limits, Reaction

# The table of conditions; see `canprobe.cell.supervision` for what its columns mean.

AGAIN = "run again"
BY_ITSELF = "by itself"
ARRAY_RECOVERY_NS = 30_000_000
"""For so long after the touch the array's creep and hysteresis may still show half of the touch force."""


def _cycles(number: int, plus_ns: int = 0) -> Callable[[Limits], int]:
    return lambda limits: number * limits.period_ns + plus_ns


def _after(name: str, cycles: int = 1) -> Callable[[Limits], int]:
    """A time of the limits, and some cycles until it is looked at."""
    return lambda limits: int(getattr(limits, name)) + cycles * limits.period_ns


def _sample(limits: Limits) -> int:
    """From an instant to the reaction on the tactile sample that shows it: sampled, sent one frame later, taken in."""
    return limits.cycles_to_feel * limits.period_ns


def _hidden(limits: Limits) -> int:
    return limits.hidden_ns + _sample(limits)


def _lost(limits: Limits) -> int:
    return limits.lost_ns + _sample(limits) + ARRAY_RECOVERY_NS


CONDITIONS: tuple[Condition, ...] = (
    # nodes
    Condition(
        "heartbeat",
        "heartbeat of a node lost",
        "none for 250 ms",
        Reaction.LIFT,
        _after("heartbeat_timeout_ns"),
        AGAIN,
        check=checks.heartbeat_lost,
        enabling=True,
    ),
    Condition(
        "nmt_state",
        "node not operational, or booted again",
        "its heartbeat, every 100 ms and at a change",
        Reaction.LIFT,
        _after("heartbeat_produced_ns"),
        AGAIN,
        check=checks.not_operational,
        enabling=True,
    ),
    Condition(
        "drive_fault",
        "drive leaves operation enabled (fault, quick stop)",
        "statusword in each TPDO",
        Reaction.LIFT,
        _cycles(2),
        "bring-up resets the fault; run again",
        check=checks.drive_not_enabled,
    ),
    Condition(
        "emcy",
        "EMCY of a device error",
        "every frame",
        Reaction.LIFT,
        _cycles(2),
        "correct what it names; run again",
        check=checks.device_emcy,
        enabling=True,
    ),
    Condition(
        "emcy_communication",
        "EMCY of communication (81xxh, 82xxh)",
        "every frame; 8100h reports a SYNC more than half a period late",
        Reaction.DEGRADE,
        _cycles(2),
        BY_ITSELF,
        "noted in `faults`, a line a code; counted",
        count=checks.communication_emcys,
    ),
    Condition(
        "foreign_master",
        "another master on the bus",
        "its SYNC, NMT or heartbeat",
        Reaction.STOP,
        _cycles(2),
        "stop it, free a pressing probe; bring-up refuses until then",
        "nothing moves where two command",
        check=checks.foreign_master,
        enabling=True,
    ),
    # PDOs
    Condition(
        "pdo_missed",
        "TPDO of a drive missed, late, twice, malformed or impossible",
        "not there 0.6 periods after its SYNC, or a position that the drive cannot have reached",
        Reaction.DEGRADE,
        _cycles(1),
        BY_ITSELF,
        "its motion is carried on; counted",
        count=checks.missed_pdos,
    ),
    Condition(
        "drive_late",
        "drive late",
        "no usable TPDO for 3 cycles",
        Reaction.HOLD,
        lambda limits: (limits.hold_cycles + 1) * limits.period_ns,
        "goes on when it is heard again",
        "no joint moves on without the other",
        check=checks.drive_late,
    ),
    Condition(
        "drive_silent",
        "drive silent",
        "no usable TPDO for more than `arm.missed_syncs` (5) cycles",
        Reaction.LIFT,
        lambda limits: (limits.missed_cycles + 2) * limits.period_ns,
        AGAIN,
        check=checks.drive_silent,
    ),
    Condition(
        "torn_frame",
        "tactile frame torn, corrupt or mixed",
        "a PDO is missing, twice or late, or the CRC is wrong",
        Reaction.DEGRADE,
        lambda limits: (limits.tactile_cycles + 2) * limits.period_ns,
        BY_ITSELF,
        "the frame is dropped; counted",
        count=checks.torn_frames,
    ),
    Condition(
        "sync_mismatch",
        "tactile frame names another SYNC than it followed",
        "its SYNC counter against its arrival",
        Reaction.DEGRADE,
        lambda limits: (limits.tactile_cycles + 2) * limits.period_ns,
        BY_ITSELF,
        "the frame is dropped; counted",
        count=checks.misplaced_frames,
    ),
    Condition(
        "sensor_stale",
        "no usable tactile frame",
        "none for 6 frame periods",
        Reaction.RETREAT,
        lambda limits: (limits.tactile_timeout + limits.tactile_cycles + 1) * limits.period_ns,
        AGAIN,
        check=checks.sensor_stale,
        touch=True,
    ),
    # the bus
    Condition(
        "error_frames",
        "bus error frames",
        "every frame: protocol, acknowledgement, bit errors",
        Reaction.DEGRADE,
        _cycles(2),
        BY_ITSELF,
        "noted in `faults` once; counted",
        count=checks.error_frames,
    ),
    Condition(
        "frames_dropped",
        "frames dropped by the kernel or the controller",
        "SO_RXQ_OVFL; overflow in an error frame",
        Reaction.DEGRADE,
        _cycles(2),
        BY_ITSELF,
        "noted in `faults` once; counted",
        count=checks.dropped_frames,
    ),
    Condition(
        "error_passive",
        "CAN controller error-passive",
        "its error frame",
        Reaction.HOLD,
        _cycles(2),
        "goes on when it is active again; after 1 s retreat",
        check=checks.error_passive,
        enabling=True,
    ),
    Condition(
        "error_passive_long",
        "CAN controller error-passive for 1 s",
        "time of the hold",
        Reaction.RETREAT,
        _after("hold_ns", 2),
        "termination, cabling, bit rate; run again",
        check=checks.held_too_long,
    ),
    Condition(
        "bus_off",
        "CAN controller bus-off",
        "its error frame",
        Reaction.STOP,
        _cycles(2),
        "free a pressing probe; `restart-ms` or `ip link set can0 type can restart`, then run again",
        "nothing can be sent any more, the drives stop by themselves",
        check=checks.bus_off,
        enabling=True,
    ),
    Condition(
        "interface",
        "interface removed or down",
        "error of the socket",
        Reaction.STOP,
        _cycles(1),
        "free a pressing probe; `ip link set can0 up`, then run again",
        "nothing can be sent any more, the drives stop by themselves",
    ),
    # time
    Condition(
        "overruns",
        "overrun budget used up",
        "`limits.late_cycles_max_percent` (10 %) of the last second's cycles late by half a period",
        Reaction.RETREAT,
        _after("hold_ns", 2),
        "a quieter machine, or a lower rate",
        check=checks.overruns,
    ),
    # the touch and the arm
    Condition(
        "preload",
        "probe pressed before the run",
        "more than `limits.preload_max_n` (0.15 N) in an image of the bring-up, whose tare takes it for zero",
        Reaction.STOP,
        None,
        "free the probe; for an array with larger offsets a larger limit",
        "no drive is enabled",
        check=checks.preloaded,
        enabling=True,
    ),
    Condition(
        "force",
        "measured force above `limits.force_max_n`",
        "every tactile frame",
        Reaction.RETREAT,
        _sample,
        AGAIN,
        check=checks.force,
        touch=True,
    ),
    Condition(
        "force_hidden",
        "force hidden by a saturated array",
        "saturated for 20 ms in a touch whose stiffness was not measured",
        Reaction.RETREAT,
        _hidden,
        "a larger `sensor.full_scale_kpa`, or a smaller `task.force_n`",
        check=checks.force_hidden,
        touch=True,
    ),
    Condition(
        "off_pad",
        "contact that runs off the array",
        "highest pressure at the edge of the array for 20 ms; the force beyond it is not measured",
        Reaction.RETREAT,
        _hidden,
        "a smaller `task.rolling_share`, speed or probe",
        check=checks.off_pad,
        touch=True,
    ),
    Condition(
        "contact_lost",
        "contact lost in a hold",
        "below a tenth of `task.force_n`, at least 0.075 N, for 30 ms",
        Reaction.RETREAT,
        _lost,
        AGAIN,
        check=checks.contact_lost,
        touch=True,
    ),
    Condition(
        "contact_to_regain",
        "contact lost in a scan",
        "below a tenth of `task.force_n`, at least 0.075 N, for 30 ms",
        Reaction.SEARCH,
        _lost,
        "goes on from where the object is found",
        "no further along the path; towards the object at 2 mm/s, for `task.regain_mm` (2); counted",
        check=checks.contact_to_regain,
        touch=True,
    ),
    Condition(
        "contact_not_regained",
        "lost contact not found again",
        "`task.regain_mm` searched",
        Reaction.RETREAT,
        _cycles(1),
        AGAIN,
        check=checks.contact_not_regained,
        touch=True,
    ),
    Condition(
        "joint_stop",
        "joint or workspace limit",
        "target beyond a stop less `limits.joint_margin_deg`, or outside `limits.workspace_*_mm`",
        Reaction.RETREAT,
        _cycles(1),
        "another path or posture",
        "the target is not sent",
        check=checks.limit_reached,
        touch=True,
    ),
    Condition(
        "target_speed",
        "target too far for one cycle",
        "`limits.joint_speed_share` of the joints' speeds",
        Reaction.DEGRADE,
        _cycles(1),
        BY_ITSELF,
        "approached at that speed; counted",
        count=checks.slowed_targets,
    ),
    Condition(
        "joint_speed",
        "measured joint motion that no joint can make",
        "between two TPDOs more than 1.5 × the speed limit allows, before the drives are enabled or after",
        Reaction.STOP,
        _cycles(2),
        "a TPDO was wrong, or the arm ran away: look first",
        check=checks.joint_speed,
        enabling=True,
    ),
    Condition(
        "estimator",
        "shape estimator diverges",
        "an answer that is not finite, or curved beyond 1/mm",
        Reaction.DEGRADE,
        _cycles(2),
        BY_ITSELF,
        "it starts afresh, the servo keeps its surface; counted",
        count=checks.estimator_restarts,
    ),
    # outside
    Condition(
        "interrupt",
        "Ctrl-C, SIGTERM, a closed terminal (SIGHUP), an exception in your controller",
        "the signal or exception",
        Reaction.LIFT,
        _cycles(2),
        AGAIN,
        "a second Ctrl-C stops at once",
    ),
    Condition(
        "master_dead",
        "master dead or killed",
        "each drive misses `arm.missed_syncs` (5) SYNCs; heartbeat consumers, 250 ms",
        Reaction.STOP,
        lambda limits: limits.missed_cycles * limits.period_ns + limits.period_ns // 2,
        AGAIN,
        "the drives quick-stop by themselves",
    ),
    Condition(
        "log",
        "frames cannot be written down (full disk)",
        "error of the file",
        Reaction.RETREAT,
        _cycles(2),
        "make room; what was written until then is whole lines",
        check=checks.log_failed,
        enabling=True,
    ),
)

BY_KEY = {condition.key: condition for condition in CONDITIONS}
CYCLE_CHECKS = tuple(c for c in CONDITIONS if c.check is not None and not c.touch)
TOUCH_CHECKS = tuple(c for c in CONDITIONS if c.check is not None and c.touch)
COUNTED = tuple(c for c in CONDITIONS if c.count is not None)


# The table of conditions as docs/supervision.md has it.

HEADINGS = ("what", "how it is seen", "at the latest after", "what the cell does", "afterwards")
USUAL = Limits(period_ns=2_500_000)
"""400 Hz, tactile frames at 200 Hz, and the other values that a scene has by default."""


def markdown_table(limits: Limits = USUAL) -> str:
    """The table in Markdown, its times for ``limits``."""
    rows = [HEADINGS, ("---",) * len(HEADINGS), *(_row(condition, limits) for condition in CONDITIONS)]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _row(condition: Condition, limits: Limits) -> tuple[str, ...]:
    does = condition.reaction.value + (f": {condition.does}" if condition.does else "")
    within = f"{condition.within(limits) / 1e6:g} ms" if condition.within is not None else "–"
    return condition.what, condition.seen, within, does, condition.back
