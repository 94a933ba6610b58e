"""The checks of the table of conditions: each looks at the cell or the contact and names what is wrong, or says None.

Pure: no clock, no port. The table is `canprobe.cell.conditions`.
"""

from __future__ import annotations

from canprobe.bus.port import ControllerState
from canprobe.cell.supervision import Contact, Seen
from canprobe.errors import InterfaceError, NodeError, ResultsError, SafetyStop
from canprobe.protocol.cia402 import DriveState
from canprobe.protocol.frames import NmtState

# nodes


def heartbeat_lost(seen: Seen) -> NodeError | None:
    """A node has been silent for longer than its heartbeat's time-out."""
    node_id = seen.watch.silent(seen.sync_ns)
    if node_id is None:
        return None
    return NodeError(node_id, "lost: no heartbeat within its time-out" + seen.watch.last_words(node_id))


def not_operational(seen: Seen) -> NodeError | None:
    """A node tells another NMT state than operational; a boot-up is one."""
    node_id = seen.watch.not_in(NmtState.OPERATIONAL)
    if node_id is None:
        return None
    state = seen.watch.states[node_id].name
    return NodeError(node_id, f"left operation: NMT state {state}{seen.watch.last_words(node_id)}")


def drive_not_enabled(seen: Seen) -> NodeError | None:
    """A drive's statusword tells another state than operation enabled."""
    drives = seen.drives
    if drives is None or seen.measurement.enabled:
        return None
    i, instead = drives.first_not_in(DriveState.OPERATION_ENABLED)
    node_id = drives.axes[i].node_id
    words = seen.watch.last_words(node_id)
    return NodeError(node_id, f"(joint {i + 1}) left operation enabled: {instead}{words}{_held_up(seen)}")


def _held_up(seen: Seen) -> str:
    """Why the drives stopped by themselves, where that is known: the master was kept from its cycle for too long."""
    patience_ns = seen.limits.missed_cycles * seen.limits.period_ns
    if seen.gap_ns <= patience_ns:
        return ""
    return (
        f"; the last SYNC was sent {seen.gap_ns * 1e-6:.0f} ms after the one before, and the drives stop by themselves"
        f" {patience_ns * 1e-6:g} ms after one (arm.missed_syncs = {seen.limits.missed_cycles}): the machine held the"
        " master up; leave it more of the processor, see --realtime, or for emulated nodes --patient"
    )


def device_emcy(seen: Seen) -> NodeError | None:
    """A device reports an error of its own."""
    event = seen.watch.device_alarm
    return NodeError(event.node_id, event.what) if event is not None else None


def communication_emcys(seen: Seen) -> int:
    """Emergencies about frames."""
    return seen.watch.communication


def foreign_master(seen: Seen) -> SafetyStop | None:
    """Somebody else sends what only a master sends."""
    foreign = seen.watch.foreign
    return SafetyStop(f"another master is on the bus: {foreign}") if foreign is not None else None


# PDOs


def missed_pdos(seen: Seen) -> int:
    """TPDOs of drives that were not there in time."""
    return seen.drives.missed + seen.drives.implausible if seen.drives is not None else 0


def drive_late(seen: Seen) -> NodeError | None:
    """A drive has not told where it is for some cycles: the others must not go on without it."""
    if max(seen.measurement.q_age, default=0) < seen.limits.hold_cycles:
        return None
    for axis, age in zip(seen.drives.axes if seen.drives is not None else (), seen.measurement.q_age, strict=True):
        if age >= seen.limits.hold_cycles:
            return NodeError(axis.node_id, f"no usable TPDO for {age} cycles")
    return None


def drive_silent(seen: Seen) -> NodeError | None:
    """A drive's TPDO has been missing for too long."""
    limit = seen.limits.missed_cycles
    if seen.drives is None or max(seen.measurement.q_age, default=0) <= limit:
        return None
    for axis, age in zip(seen.drives.axes, seen.measurement.q_age, strict=True):
        if age > limit:
            return NodeError(axis.node_id, f"lost: no usable TPDO for {age} cycles")
    return None


def torn_frames(seen: Seen) -> int:
    """Tactile frames dropped for what they are."""
    if seen.tactile is None:
        return 0
    assembler = seen.tactile.assembler
    return assembler.torn + assembler.crc_errors + assembler.orphans + assembler.malformed + assembler.duplicates


def misplaced_frames(seen: Seen) -> int:
    """Tactile frames dropped for their place in time."""
    return seen.tactile.stale if seen.tactile is not None else 0


# the bus


def error_frames(seen: Seen) -> int:
    """Error frames."""
    return seen.counters.error_frames


def dropped_frames(seen: Seen) -> int:
    """Frames that the kernel dropped."""
    return seen.counters.overruns


def error_passive(seen: Seen) -> SafetyStop | None:
    """The controller may only listen to errors, not signal them, and not for long."""
    if seen.controller_state is not ControllerState.PASSIVE or seen.passive_ns > seen.limits.hold_ns:
        return None
    return SafetyStop("CAN controller error-passive")


def held_too_long(seen: Seen) -> SafetyStop | None:
    """The controller has been error-passive for too long."""
    if seen.passive_ns <= seen.limits.hold_ns:
        return None
    return SafetyStop(f"CAN controller error-passive for {seen.passive_ns * 1e-9:.1f} s: check termination and cabling")


def bus_off(seen: Seen) -> InterfaceError | None:
    """The controller has left the bus."""
    if seen.controller_state is not ControllerState.BUS_OFF:
        return None
    return InterfaceError("CAN controller bus-off: check bit rate, termination and cabling, then restart the interface")


# time, arm, files


def overruns(seen: Seen) -> SafetyStop | None:
    """Too many cycles of the last second were late."""
    if seen.late_share <= seen.limits.late_share:
        return None
    return SafetyStop(
        f"{100 * seen.late_share:.0f} % of the last second's cycles came more than half a period late,"
        f" limit {100 * seen.limits.late_share:.0f} %"
    )


def joint_speed(seen: Seen) -> SafetyStop | None:
    """A measured joint moved as none can."""
    return SafetyStop(seen.speeding) if seen.speeding is not None else None


def slowed_targets(seen: Seen) -> int:
    """Targets that were too far away for one cycle."""
    return seen.slowed


def estimator_restarts(seen: Seen) -> int:
    """Restarts of the estimator."""
    return seen.restarts


def log_failed(seen: Seen) -> ResultsError | None:
    """Frames are no longer written down."""
    return ResultsError(seen.log_failure) if seen.log_failure is not None else None


# the touch


def force(contact: Contact) -> SafetyStop | None:
    """The measured force is above the limit."""
    limit = contact.limits.force_max
    if contact.force <= limit:
        return None
    return SafetyStop(f"measured force {contact.force:.2f} N above the limit of {limit:.2f} N")


def preloaded(seen: Seen) -> SafetyStop | None:
    """The array felt something before the run could have touched anything."""
    if seen.preload <= seen.limits.preload_max:
        return None
    return SafetyStop(
        f"the array feels {seen.preload:.2f} N before the run, more than limits.preload_max_n ="
        f" {seen.limits.preload_max:g}, and its tare takes that for zero: free the probe; if it is free, it was pressed"
        " until just now, which its array forgets in a minute, or the array's offsets are larger than that"
    )


def force_hidden(contact: Contact) -> SafetyStop | None:
    """The array has been saturated for so long that the force may be above the limit, and nobody knows."""
    if contact.hidden_s * 1e9 <= contact.limits.hidden_ns:
        return None
    return SafetyStop(
        f"the array is saturated and no stiffness was felt: the true force is above the {contact.force:.1f} N "
        "measured; raise sensor.full_scale_kpa or lower task.force_n"
    )


def off_pad(contact: Contact) -> SafetyStop | None:
    """The contact has been running off the array for so long that the force may be above the limit."""
    if contact.off_pad_s * 1e9 <= contact.limits.hidden_ns:
        return None
    return SafetyStop(
        f"the contact runs off the edge of the array: the true force is above the {contact.force:.1f} N measured; let"
        " the pad follow the surface (a smaller task.rolling_share or task.speed_mm_s), or take a smaller probe"
    )


def sensor_stale(contact: Contact) -> SafetyStop | None:
    """No tactile sample for too long."""
    age = contact.tactile_age
    if age is None or age <= contact.limits.tactile_timeout:
        return None
    return SafetyStop(f"no tactile frame for {age} cycles")


def contact_lost(contact: Contact) -> SafetyStop | None:
    """No force where there must be one, and nothing to be done about it."""
    if contact.path and contact.limits.regain > 0.0:
        return None
    return SafetyStop("contact lost") if contact.lost_s * 1e9 > contact.limits.lost_ns else None


def contact_to_regain(contact: Contact) -> SafetyStop | None:
    """No force where a scan must have one, which looks for it."""
    if not contact.path or contact.lost_s * 1e9 <= contact.limits.lost_ns:
        return None
    return SafetyStop("contact lost")


def contact_not_regained(contact: Contact) -> SafetyStop | None:
    """The object is not where a lost contact was looked for."""
    if contact.searched <= contact.limits.regain:
        return None
    return SafetyStop(f"contact lost, and not found again within {contact.limits.regain * 1e3:.1f} mm")


def limit_reached(contact: Contact) -> SafetyStop | None:
    """A joint is at its stop, or the probe at the border of its workspace."""
    return SafetyStop(contact.limit) if contact.limit is not None else None
