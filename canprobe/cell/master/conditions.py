"""The table of conditions: what can go wrong, how it is seen, how fast, and what the cell does about it.

Each row stands on its check. A check looks at the cell (`CycleState`) or at a touch (`TouchState`) and returns the
error that names what is wrong, or None; conditions that do not stop the cell are counted. Pure: no clock, no port. The
order is the order of precedence. docs/supervision.md has the same table for users, with what they can do about each
condition; a test compares the two.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

from canprobe.cell.master.image_witness import UNSTATED_NS
from canprobe.cell.master.supervision import Condition, CycleState, Finding, Limits, Reaction, TouchState
from canprobe.cell.planning.model import HEARTBEAT_CONSUMED_MS, HEARTBEAT_PRODUCED_MS
from canprobe.errors import BusError, InterfaceError, NodeError, ResultsError, SafetyStop
from canprobe.fieldbus.bus.port import ControllerState
from canprobe.fieldbus.protocol.cia402 import DriveState
from canprobe.fieldbus.protocol.frames import NmtState
from canprobe.mechanics.touch.depth_witness import CONTRADICTED_S
from canprobe.mechanics.touch.stops import TORQUE_MEAN_NS

NS_PER_MS, NS_PER_S = 1_000_000, 1_000_000_000
HOLD_CYCLES = 3
"""Cycles without a TPDO of one drive after which all of them hold."""
MAX_HOLD_NS = 1_000_000_000
"""Longest hold."""
CONTACT_LOST_NS = 30_000_000
"""Time without contact force in a touch after which the contact is lost."""
FORCE_HIDDEN_NS = 20_000_000
"""Time with a force that the array shows only in part, after which the force may be above the limit."""
ARRAY_RECOVERY_NS = 30 * NS_PER_MS
"""Time after a touch in which the array's creep and hysteresis may still show half of the touch force."""
_BLIND_ADVICE = "look at the arm before anything moves, then press the array with a finger: `canprobe run listen`"
Within = Callable[[Limits], int]
Check = TypeVar("Check", bound=Callable[..., Any])
_TABLE: list[Condition] = []


def _checked(what: str, reaction: Reaction, within: Within | None, **more: Any) -> Callable[[Check], Check]:
    """Add a row whose check looks at the cell in every cycle; its key is the name of the check."""

    def add(check: Check) -> Check:
        _TABLE.append(Condition(check.__name__.removeprefix("_"), what, reaction, within, check, **more))
        return check

    return add


_touch = partial(_checked, touch=True)
"""Add a row whose check looks at a touch."""


def _counted(key: str, what: str, within: Within, count: Callable[[CycleState], int]) -> None:
    """Add a row of a condition that is counted and does not stop the cell."""
    _TABLE.append(Condition(key, what, Reaction.DEGRADE, within, count=count))


def _unchecked(*row: Any) -> None:
    """Add a row without a check: the condition shows by itself."""
    _TABLE.append(Condition(*row))


def _cycles(number: int) -> Within:
    return lambda limits: number * limits.period_ns


def _after(time_ns: int, cycles: int = 1) -> Within:
    """A time, and the cycles until the check runs."""
    return lambda limits: time_ns + cycles * limits.period_ns


def _frame(limits: Limits) -> int:
    """Time from a tactile frame to the reaction on it."""
    return (limits.tactile_cycles + 2) * limits.period_ns


def _missed(limits: Limits) -> int:
    """Time until a node that misses more than `missed_cycles` is noticed, ns."""
    return (limits.missed_cycles + 2) * limits.period_ns


def _sample(limits: Limits) -> int:
    """Time from an instant to the reaction on the tactile sample of it, which is sent a frame later."""
    return limits.cycles_to_feel * limits.period_ns


def _hidden(limits: Limits) -> int:
    return FORCE_HIDDEN_NS + _sample(limits)


def _lost(limits: Limits) -> int:
    return CONTACT_LOST_NS + _sample(limits) + ARRAY_RECOVERY_NS


# nodes; another master first: what the nodes then report is what it made of them


@_checked("another master on the bus", Reaction.STOP, _cycles(2), enabling=True)
def _foreign_master(seen: CycleState) -> SafetyStop | None:
    words = seen.watch.another_master
    return SafetyStop(words) if words is not None else None


@_checked("heartbeat of a node lost", Reaction.LIFT, _after(HEARTBEAT_CONSUMED_MS * NS_PER_MS), enabling=True)
def _heartbeat(seen: CycleState) -> NodeError | None:
    node_id = seen.watch.silent(seen.sync_ns)
    if node_id is None:
        return None
    return NodeError(node_id, "lost: no heartbeat within its time-out" + seen.watch.last_words(node_id))


@_checked(
    "node not operational, or booted again", Reaction.LIFT, _after(HEARTBEAT_PRODUCED_MS * NS_PER_MS), enabling=True
)
def _nmt_state(seen: CycleState) -> NodeError | None:
    node_id = seen.watch.not_in(NmtState.OPERATIONAL)
    if node_id is None:
        return None
    state = seen.watch.states[node_id].name
    return NodeError(node_id, f"left operation: NMT state {state}{seen.watch.last_words(node_id)}")


@_checked("drive leaves operation enabled (fault, quick stop)", Reaction.LIFT, _cycles(2))
def _drive_fault(seen: CycleState) -> NodeError | None:
    drives = seen.drives
    if drives is None or seen.measurement.enabled:
        return None
    i, instead = drives.first_not_in(DriveState.OPERATION_ENABLED)
    node_id = drives.axes[i].node_id
    words = seen.watch.last_words(node_id) + _held_up(seen)
    if not words and instead == DriveState.SWITCH_ON_DISABLED.name:
        words = "; it gave no reason, as with STO or an emergency stop"
    return NodeError(node_id, f"(joint {i + 1}) left operation enabled: {instead}{words}")


def _held_up(seen: CycleState) -> str:
    """Why the drives stopped by themselves, where that is known: the master was late in its cycle for too long."""
    patience_ns = seen.limits.missed_cycles * seen.limits.period_ns
    if seen.gap_ns <= patience_ns:
        return ""
    patient = seen.limits.safety.late_share >= 1.0  # as --patient sets it, and the drives wait longer already
    more = "or a larger arm.missed_syncs" if patient else "or for emulated nodes --patient"
    return (
        f"; the last SYNC was sent {seen.gap_ns * 1e-6:.0f} ms after the one before, and the drives stop by themselves"
        f" {patience_ns * 1e-6:g} ms after one (arm.missed_syncs = {seen.limits.missed_cycles}): the machine held the"
        f" master up; leave it more of the processor, see --realtime, {more}"
    )


@_checked("EMCY of a device error", Reaction.LIFT, _cycles(2), enabling=True)
def _emcy(seen: CycleState) -> NodeError | None:
    event = seen.watch.device_alarm
    return NodeError(event.node_id, event.what) if event is not None else None


_counted(
    "emcy_communication", "EMCY of communication (81xxh, 82xxh)", _cycles(2), lambda seen: seen.watch.communication
)


# PDOs


def _pdo_missed(seen: CycleState) -> int:
    return seen.drives.missed + seen.drives.implausible if seen.drives is not None else 0


_counted("pdo_missed", "TPDO of a drive missed, late, twice, malformed or impossible", _cycles(1), _pdo_missed)


@_checked("drive late", Reaction.HOLD, lambda limits: (HOLD_CYCLES + 1) * limits.period_ns)
def _drive_late(seen: CycleState) -> BusError | None:
    return _not_heard(seen, HOLD_CYCLES, "")


@_checked("drive silent", Reaction.LIFT, _missed)
def _drive_silent(seen: CycleState) -> BusError | None:
    return _not_heard(seen, seen.limits.missed_cycles + 1, "lost: ")


def _not_heard(seen: CycleState, cycles: int, word: str) -> BusError | None:
    """The first drive without a usable TPDO for so many cycles."""
    ages = seen.measurement.q_age
    if not any(ages) or max(ages) < cycles:
        return None
    assert seen.drives is not None
    i = next(i for i, age in enumerate(ages) if age >= cycles)
    axis = seen.drives.axes[i]
    if not axis.node_id:
        return axis.error(f"{word}no usable pose for {ages[i] * seen.limits.period_ns * 1e-6:.0f} ms more than usual")
    return axis.error(f"{word}no usable TPDO for {ages[i]} cycles")


@_checked("position of the carrier lost, or a jump of it", Reaction.RETREAT, _missed, enabling=True)
def _carrier(seen: CycleState) -> NodeError | None:
    return seen.carrier.lost if seen.carrier is not None else None


@_checked("joint that does not follow its targets", Reaction.LIFT, _cycles(2))
def _following(seen: CycleState) -> BusError | None:
    drives = seen.drives
    if drives is None or seen.compares_motion or not (beyond := drives.targets.beyond_lag()):
        return None
    i, model = max(beyond, key=beyond.__getitem__), drives.model
    motion = model.joints[i].text(abs(beyond[i] / float(model.units_per_q[i, i])), ".2g")
    lag_ms = seen.limits.lag_ns * 1e-6
    lag = f"a lag of {lag_ms:.3g} ms (servo.drive_lag_ms)" if lag_ms else "its lag"
    return drives.axes[i].error(
        f"(joint {i + 1}) does not follow its targets: its motion is {motion} beside what"
        f" {lag} explains; see to its brake and its power stage, or state the lag of the drive",
    )


def _torn_frame(seen: CycleState) -> int:
    return seen.tactile.unusable if seen.tactile is not None else 0


_counted("torn_frame", "tactile frame torn, corrupt or mixed", _frame, _torn_frame)


def _sync_mismatch(seen: CycleState) -> int:
    return seen.tactile.stale if seen.tactile is not None else 0


_counted("sync_mismatch", "tactile frame names another SYNC than it followed", _frame, _sync_mismatch)


_counted(
    "silent_taxels", "row, column or taxel that does not measure", _after(NS_PER_S, 0), lambda seen: seen.silent_taxels
)


@_touch(
    "no usable tactile frame",
    Reaction.RETREAT,
    lambda limits: (limits.tactile_timeout + limits.tactile_cycles + 1) * limits.period_ns,
)
def _sensor_stale(contact: TouchState) -> SafetyStop | None:
    age = contact.tactile_age
    if age is None or age <= contact.limits.tactile_timeout:
        return None
    return SafetyStop(f"no tactile frame for {age} cycles")


# the bus


_counted("error_frames", "bus error frames", _cycles(2), lambda seen: seen.counters.error_frames)


_counted(
    "frames_dropped", "frames dropped by the kernel or the controller", _cycles(2), lambda seen: seen.counters.overruns
)


@_checked("CAN controller error-passive", Reaction.HOLD, _cycles(2), enabling=True)
def _error_passive(seen: CycleState) -> SafetyStop | None:
    if seen.controller_state is not ControllerState.PASSIVE or seen.passive_ns > MAX_HOLD_NS:
        return None
    return SafetyStop("CAN controller error-passive")


@_checked("CAN controller error-passive for 1 s", Reaction.RETREAT, _after(MAX_HOLD_NS, 2))
def _error_passive_long(seen: CycleState) -> SafetyStop | None:
    if seen.passive_ns <= MAX_HOLD_NS:
        return None
    return SafetyStop(f"CAN controller error-passive for {seen.passive_ns * 1e-9:.1f} s: check termination and cabling")


@_checked("CAN controller bus-off", Reaction.STOP, _cycles(2), enabling=True)
def _bus_off(seen: CycleState) -> InterfaceError | None:
    if seen.controller_state is not ControllerState.BUS_OFF:
        return None
    return InterfaceError("CAN controller bus-off: check bit rate, termination and cabling, then restart the interface")


_unchecked("interface", "interface removed or down", Reaction.STOP, _cycles(1))


# time


_counted("clock_step", "wall clock set", _cycles(2), lambda seen: seen.counters.clock_steps)


@_checked("overrun budget used up", Reaction.RETREAT, _after(MAX_HOLD_NS, 2))
def _overruns(seen: CycleState) -> SafetyStop | None:
    if seen.late_share <= seen.limits.safety.late_share:
        return None
    return SafetyStop(
        f"{100 * seen.late_share:.1f} % of the last second's cycles came more than half a period late,"
        f" limit {100 * seen.limits.safety.late_share:.0f} %"
    )


# the touch and the arm


@_checked("probe pressed before the run", Reaction.STOP, None, enabling=True)
def _preload(seen: CycleState) -> SafetyStop | None:
    limits = seen.limits
    if not limits.tares or seen.preload <= limits.safety.preload_max:
        return None
    return SafetyStop(
        f"the array measures {seen.preload:.2f} N before the run, more than limits.preload_max_n ="
        f" {limits.safety.preload_max:g}; its tare would take that for zero: free the probe. If it is free, wait a"
        " minute after the last press, or raise limits.preload_max_n for an array with larger offsets"
    )


@_touch("upper end of the measured force above `limits.force_max_n`", Reaction.RETREAT, _sample)
def _force(contact: TouchState) -> SafetyStop | None:
    limit = contact.limits.safety.force_max
    if contact.force_upper <= limit:
        return None
    upper = f", or up to {contact.force_upper:.2f} N (2σ)," if contact.force_upper > contact.force else ""
    return SafetyStop(f"measured force {contact.force:.2f} N{upper} above the limit of {limit:.2f} N")


@_touch("force hidden by a saturated array", Reaction.RETREAT, _hidden)
def _force_hidden(contact: TouchState) -> SafetyStop | None:
    if contact.hidden_s * 1e9 <= FORCE_HIDDEN_NS:
        return None
    return SafetyStop(
        f"the array is saturated and no stiffness was measured: the true force is above the {contact.force:.1f} N "
        "measured; raise sensor.full_scale_kpa or lower task.force_n"
    )


@_touch("contact that runs off the array", Reaction.RETREAT, _hidden)
def _off_pad(contact: TouchState) -> SafetyStop | None:
    if contact.off_pad_s * 1e9 <= FORCE_HIDDEN_NS:
        return None
    return SafetyStop(
        f"the contact runs off the edge of the array: the true force is above the {contact.force:.1f} N measured; let"
        " the pad follow the surface (a smaller task.rolling_share or task.speed_mm_s), or take a smaller probe, or an"
        " array that the whole contact fits on"
    )


@_touch("force on taxels that do not measure", Reaction.RETREAT, _hidden)
def _taxels_hidden(contact: TouchState) -> SafetyStop | None:
    if contact.bridged_s * 1e9 <= FORCE_HIDDEN_NS:
        return None
    return SafetyStop(
        f"{100.0 * contact.bridged:.0f} % of the force lies on taxels that do not measure (named in faults): it is not"
        " known; press elsewhere on the array, or have it repaired"
    )


@_touch(
    "pressed array whose images do not change though the probe moves",
    Reaction.RETREAT,
    lambda limits: UNSTATED_NS + _sample(limits),
    blind=True,
)
def _image_dead(contact: TouchState) -> SafetyStop | None:
    since_ns = contact.images.dead_since_ns
    if since_ns is None:
        return None
    return SafetyStop(f"{contact.images.words}: it does not measure any more; {_BLIND_ADVICE}")


@_touch(
    "measured force that falls faster than the probe moves off",
    Reaction.RETREAT,
    lambda limits: round(NS_PER_S * CONTRADICTED_S) + _sample(limits) + _frame(limits),
    blind=True,
)
def _force_fell(contact: TouchState) -> SafetyStop | None:
    fall = contact.depth.fall if contact.depth is not None else None
    if fall is None or fall.lasts_s < CONTRADICTED_S:
        return None
    return SafetyStop(
        f"the measured force fell from {fall.before:.2f} to {fall.after:.2f} N within {fall.within_s * 1e3:.0f} ms,"
        " faster than the probe can have moved off: the array reads too low or is blind, or the object was taken away;"
        f" {_BLIND_ADVICE}"
    )


@_touch(
    "probe far deeper in what it touched before than the measured force means, or gone aside in a hold",
    Reaction.RETREAT,
    lambda limits: round(NS_PER_S * CONTRADICTED_S) + 4 * _sample(limits),
    blind=True,
)
def _depth(contact: TouchState) -> SafetyStop | None:
    depth = contact.depth
    if depth is None or not depth.contradicts:
        return None
    if depth.wandered is not None:
        return SafetyStop(
            f"the probe has gone {depth.wandered * 1e3:.1f} mm aside in a touch of one place, as the array shows its"
            f" contact elsewhere: the array does not measure, or the object moves; {_BLIND_ADVICE}"
        )
    return SafetyStop(
        f"the array measures {contact.force:.2f} N where the probe's depth in the surface that it touched before means"
        f" {depth.force:.1f} N: the array reads too low, the object has moved, or the layer is softer than stated;"
        f" {_BLIND_ADVICE}"
    )


@_checked(
    "push in the drives' torques that the array does not measure",
    Reaction.RETREAT,
    _after(4 * TORQUE_MEAN_NS, 2),
    blind=True,
)
def _push_unfelt(seen: CycleState) -> SafetyStop | None:
    if seen.unfelt is None:
        return None
    return SafetyStop(
        f"the torques of the drives show a push of {seen.unfelt:.1f} N beyond the {seen.force:.2f} N that the array"
        f" measures: the array may be blind, or the arm touches beside it; {_BLIND_ADVICE}"
    )


@_touch("contact lost in a hold", Reaction.RETREAT, _lost)
def _contact_lost(contact: TouchState) -> SafetyStop | None:
    if _is_doubtful(contact) or (contact.path and contact.limits.regain > 0.0):
        return None
    return SafetyStop("contact lost") if contact.lost_s * 1e9 > CONTACT_LOST_NS else None


@_touch("contact lost in a scan", Reaction.SEARCH, _lost)
def _contact_to_regain(contact: TouchState) -> SafetyStop | None:
    if not contact.path or _is_doubtful(contact) or contact.lost_s * 1e9 <= CONTACT_LOST_NS:
        return None
    return SafetyStop("contact lost")


def _is_doubtful(contact: TouchState) -> bool:
    """Whether it is not clear yet if the contact is lost or the array is blind."""
    return contact.depth is not None and contact.depth.fall is not None


@_touch("lost contact not found again", Reaction.RETREAT, _cycles(1))
def _contact_not_regained(contact: TouchState) -> SafetyStop | None:
    if contact.searched <= contact.limits.regain:
        return None
    return SafetyStop(f"contact lost, and not found again within {contact.limits.regain * 1e3:.1f} mm")


_unchecked("joint_stop", "joint or workspace limit", Reaction.RETREAT, _cycles(1))


_counted("target_speed", "target too far for one cycle", _cycles(1), lambda seen: seen.slowed)


@_checked("measured joint motion that no joint can make", Reaction.STOP, _cycles(2), enabling=True)
def _joint_speed(seen: CycleState) -> SafetyStop | None:
    return SafetyStop(seen.speeding) if seen.speeding is not None else None


_counted("estimator", "shape estimator diverges", _cycles(2), lambda seen: seen.restarts)


# outside


_unchecked(
    "interrupt",
    "Ctrl-C, SIGTERM, a closed terminal (SIGHUP), an exception in your controller",
    Reaction.LIFT,
    _cycles(2),
)


_unchecked(
    "master_dead",
    "master dead or killed",
    Reaction.STOP,
    lambda limits: limits.missed_cycles * limits.period_ns + limits.period_ns // 2,
)


@_checked("frames cannot be written down (full disk)", Reaction.RETREAT, _cycles(2), enabling=True)
def _log(seen: CycleState) -> ResultsError | None:
    return ResultsError(seen.log_failure) if seen.log_failure is not None else None


CONDITIONS = tuple(_TABLE)
BY_KEY = {condition.key: condition for condition in CONDITIONS}
CYCLE_CHECKS = tuple(c for c in CONDITIONS if c.check is not None and not c.touch)
TOUCH_CHECKS = tuple(c for c in CONDITIONS if c.check is not None and c.touch)
COUNTERS = tuple((c.key, c.count) for c in CONDITIONS if c.count is not None)


def touch_finding(contact: TouchState) -> Finding | None:
    """The first condition of a touch that holds."""
    for condition in TOUCH_CHECKS:
        error = condition.check(contact)  # type: ignore[misc]  # TOUCH_CHECKS have one
        if error is not None:
            return Finding(condition, error)
    return None
