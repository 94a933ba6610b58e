"""What can go wrong in a running cell: what a condition is, and the checks that the table of conditions names.

The table `CONDITIONS` drives the checks of :class:`canprobe.cell.supervisor.Supervisor` and of the touch tasks, and
docs/supervision.md has it (`canprobe.cell.conditions`). What a check needs is in `Seen`; `Limits` follows from
the plan.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.bus.port import ControllerState, PortCounters
from canprobe.cell.controller import Measurement
from canprobe.cell.drives import DriveGroup, TactileReceiver
from canprobe.cell.watch import NodeWatch
from canprobe.errors import CanprobeError, InterfaceError, NodeError, ResultsError, SafetyStop
from canprobe.protocol.cia402 import DriveState
from canprobe.protocol.frames import NmtState
from canprobe.robot.model import Joint

# What can go wrong in a running cell: one row a condition, with its check, its time, its reaction and the way back.

Vector = NDArray[np.float64]
TOUCH_FORCE = 0.15
"""N; contact is made above it, and gone below half of it: an image of less tells nothing about its place."""


class Reaction(Enum):
    """What the cell does about a condition, the mildest first."""

    DEGRADE = "degrade"
    HOLD = "hold"
    SEARCH = "search"
    RETREAT = "retreat"
    LIFT = "lift off, quick stop"
    STOP = "quick stop"


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """The numbers behind the checks, from the plan.

    Attributes:
        period_ns: of the cycle.
        hold_cycles: without a TPDO of one drive after which all of them hold.
        missed_cycles: without a TPDO after which a drive is lost, and SYNCs after which it takes its master for dead.
        heartbeat_produced_ns, heartbeat_timeout_ns: between two heartbeats, and silence after which a node is lost.
        tactile_cycles: between two tactile frames.
        tactile_timeout: cycles without a tactile sample.
        lost_ns: without contact force in a touch after which the contact is lost.
        hidden_ns: with a saturated array, and no other knowledge of the force, or with a contact that runs off it,
            after which the force may be above the limit.
        regain: way towards the object on which a scan looks for a lost contact, m; 0: it does not.
        force_max: N.
        preload_max: force before a run, N, above which it does not begin; infinite where the array is not tared.
        late_share: of the last second's cycles that may be overruns.
        hold_ns: longest hold.
        joints: of the arm; none without one.
        joint_low, joint_high: range of the joint targets (n,), rad or m; None without an arm.
        joint_speed: speed limits (n,), rad/s or m/s.
        count: joint motion of one drive unit (n,), rad or m.
        workspace: lowest and highest position (2, 3) of the probe's tip, m, base frame; None without one.
        T_base_tip_of: transform (4, 4) from the probe's tip (z = pole, towards the object) to base, of joint angles
            (n,), rad or m; None without an arm.
    """

    period_ns: int
    hold_cycles: int = 3
    missed_cycles: int = 5
    heartbeat_produced_ns: int = 100_000_000
    heartbeat_timeout_ns: int = 250_000_000
    tactile_cycles: int = 2
    tactile_timeout: int = 12
    lost_ns: int = 30_000_000
    hidden_ns: int = 20_000_000
    regain: float = 0.0
    force_max: float = 5.0
    preload_max: float = math.inf
    late_share: float = 0.1
    hold_ns: int = 1_000_000_000
    joints: tuple[Joint, ...] = ()
    joint_low: Vector | None = None
    joint_high: Vector | None = None
    joint_speed: Vector | None = None
    count: Vector | None = None
    workspace: Vector | None = None
    T_base_tip_of: Callable[[Vector], Vector] | None = None

    @property
    def cycles_to_feel(self) -> int:
        """From a motion to the cycle that has taken in a tactile sample of it."""
        return 2 * self.tactile_cycles + 2


@dataclass(slots=True)
class Seen:
    """The cell in one cycle, as the checks see it.

    Attributes:
        limits: of the plan.
        watch: heartbeats and emergencies.
        drives, tactile: the arm and the sensor, None where there is none.
        counters: of the port.
        controller_state: of the CAN controller.
        measurement: of this cycle.
        sync_ns: when its SYNC went out, on the port's clock.
        gap_ns: from the SYNC before to it; 0 for the first.
        overruns: cycles late so far.
        late_share: share of the last second's cycles that were late.
        passive_ns: how long the controller has been error-passive.
        speeding: what a joint did that no joint can do; None where all is well.
        slowed: targets so far that were too far away for one cycle.
        restarts: of a diverging estimator so far.
        preload: highest force in the images before the drives are enabled, N.
        log_failure: why frames are no longer written down; None while they are.
    """

    limits: Limits
    watch: NodeWatch
    drives: DriveGroup | None
    tactile: TactileReceiver | None
    counters: PortCounters
    controller_state: ControllerState = ControllerState.ACTIVE
    measurement: Measurement = field(default_factory=lambda: Measurement(0, 0))
    sync_ns: int = 0
    gap_ns: int = 0
    overruns: int = 0
    late_share: float = 0.0
    passive_ns: int = 0
    speeding: str | None = None
    slowed: int = 0
    restarts: int = 0
    preload: float = 0.0
    log_failure: str | None = None


@dataclass(slots=True, eq=False)  # not frozen: one is made in every cycle, and freezing triples its cost
class Contact:
    """A touch as its checks see it.

    Attributes:
        limits: of the plan.
        force: as measured last, N.
        tactile_age: cycles since the trigger of the newest sample, or since the first SYNC where none has come; None
            without a sensor.
        lost_s: how long the force has been below that of a contact, where there must be one.
        hidden_s: how long the array has been saturated while nothing else tells the force.
        off_pad_s: how long a good part of the contact has been beyond the array's edge.
        path: the touch is a scan, which may look for a contact that it has lost.
        searched: how far it has gone towards the object since, m.
        limit: what a joint or the workspace forbids; None where all is well.
    """

    limits: Limits
    force: float
    tactile_age: int | None
    lost_s: float = 0.0
    hidden_s: float = 0.0
    off_pad_s: float = 0.0
    path: bool = False
    searched: float = 0.0
    limit: str | None = None


@dataclass(frozen=True, slots=True)
class Condition:
    """One row of the table.

    Attributes:
        key: its name in code, tests and studies.
        what: for people.
        seen: how it is detected, for people.
        reaction: what the cell does.
        within: longest time from the fault to the reaction, ns; None where no such time applies.
        back: what the user or the cell does afterwards.
        does: more about the reaction, for people.
        check: of a `Seen` in every cycle, or of a `Contact` in a touch: the error that names what is wrong, or None.
            A condition without check and count shows by itself: an exception, or a node that stops.
        count: for what the cell lives with: how often it has happened.
        touch: the check takes a `Contact`.
        enabling: the check holds already while the drives are enabled.
    """

    key: str
    what: str
    seen: str
    reaction: Reaction
    within: Callable[[Limits], int] | None
    back: str
    does: str = ""
    check: Callable[[Any], CanprobeError | None] | None = None
    count: Callable[[Seen], int] | None = None
    touch: bool = False
    enabling: bool = False


# The checks of the table of conditions: each looks at the cell or the contact and names what is wrong, or says None.
#
# Pure: no clock, no port. The table is `canprobe.cell.conditions`.

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
