"""Data of the supervision: the limits of a plan, the cell and the touch as checks see them, and a condition.

The table of conditions with its checks is in `canprobe.cell.master.conditions`; `canprobe.cell.master.supervisor` runs
it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any

from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.image_witness import ImageWitness
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.sync import CYCLES_TO_EFFECT
from canprobe.cell.planning.units import lag_s
from canprobe.cell.scene.setup import SafetyLimits
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.port import ControllerState, PortCounters
from canprobe.mechanics.touch.image.force_errors import upper_end
from canprobe.mechanics.touch.stops import MAX_BRIDGED_SHARE, TOUCH_FORCE

if TYPE_CHECKING:
    from canprobe.cell.master.array import ArrayReceiver
    from canprobe.cell.master.carrier import CarrierReceiver
    from canprobe.cell.master.drives import DriveGroup
    from canprobe.mechanics.touch import Patch
    from canprobe.mechanics.touch.depth_witness import DepthWitness

TACTILE_TIMEOUT_PERIODS = 6
"""Periods of the array without a sample after which it counts as silent."""


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """The limits of a plan that the checks compare with.

    Attributes:
        safety: the limits of the setup.
        period_ns: period of the cycle.
        missed_cycles: cycles without a TPDO after which a drive is lost, and SYNCs after which it takes its master for
            dead.
        tactile_cycles: cycles between two tactile frames.
        tactile_timeout: cycles without a tactile sample.
        regain: distance towards the object on which a scan searches for a lost contact, m; 0: it does not.
        tares: the array is tared in bring-up, so that nothing may press on it then.
        lag_ns: lag of the drives behind a ramp; 0: unknown.
    """

    safety: SafetyLimits
    period_ns: int
    missed_cycles: int = 5
    tactile_cycles: int = 2
    tactile_timeout: int = 12
    regain: float = 0.0
    tares: bool = False
    lag_ns: int = 0

    @property
    def cycles_to_feel(self) -> int:
        """Cycles from a motion to the cycle that has taken in a tactile sample of it."""
        return 2 * self.tactile_cycles + 2

    @property
    def cycles_to_turn(self) -> int:
        """Cycles from a command to the cycle that has taken in a tactile sample of the motion that it has turned."""
        return self.cycles_to_feel + CYCLES_TO_EFFECT - (-2 * self.lag_ns // self.period_ns)


def limits_of(plan: Plan) -> Limits:
    """The limits of a plan, and how fast the cell notices that they are exceeded."""
    setup = plan.setup
    ratio = setup.rate_hz / setup.array.rate_hz if setup.array is not None else 1.0
    return Limits(
        setup.limits,
        plan.sync.period_ns,
        missed_cycles=setup.arm.missed_syncs if setup.arm is not None else 5,
        tactile_cycles=round(ratio),
        tactile_timeout=math.ceil(TACTILE_TIMEOUT_PERIODS * ratio),
        regain=setup.scan.regain if setup.scan is not None else 0.0,
        tares=setup.tares,
        lag_ns=round(lag_s(setup) * 1e9),
    )


@dataclass(slots=True)
class CycleState:
    """The cell in one cycle, as the checks see it.

    Attributes:
        limits: limits of the plan.
        watch: heartbeats and emergencies.
        drives, tactile: the drives of the arm and the receiver of the array; None without an arm or an array.
        counters: counters of the port.
        controller_state: state of the CAN controller.
        measurement: measurement of this cycle.
        sync_ns: time at which its SYNC was sent, on the port's clock.
        gap_ns: time from the SYNC before to this one; 0 for the first.
        overruns: cycles late so far.
        late_share: share of the last second's cycles that were late.
        passive_ns: time for which the CAN controller has been error-passive.
        speeding: a measured motion that no joint can make; None without one.
        slowed: targets so far that were too far away for one cycle.
        restarts: how often a diverging estimator has started again so far.
        silent_taxels: number of taxels that were found not to measure.
        preload: highest force in the images before the drives are enabled, N.
        log_failure: why frames are no longer written down; None while they are.
        compares_motion: the controller compares the motion of the joints with its targets itself.
        unfelt: push in the drives' torques that the array does not measure, N; None without one.
        patch: patch in the last image of the array; None before it, and without an arm that could press.
        carrier: receiver of the carrier's position; None where the object stands still.
    """

    limits: Limits
    watch: NodeWatch
    drives: DriveGroup | None
    tactile: ArrayReceiver | None
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
    silent_taxels: int = 0
    preload: float = 0.0
    log_failure: str | None = None
    compares_motion: bool = False
    unfelt: float | None = None
    patch: Patch | None = None
    carrier: CarrierReceiver | None = None

    @property
    def force(self) -> float:
        """Force that the array measures, N; 0 where nothing can press."""
        return 0.0 if self.patch is None else self.patch.force

    @property
    def shows_a_part(self) -> bool:
        """Whether the array shows only a part of the force: it is saturated, or the contact runs off it."""
        return self.patch is not None and not math.isfinite(self.patch.sigma.total)


@dataclass(slots=True, eq=False)
class TouchState:
    """A touch as its checks see it, kept up to date from sample to sample.

    Attributes:
        limits: limits of the plan.
        force: force that was measured last, N.
        tactile_age: cycles since the trigger of the newest sample, or since the first SYNC where none has come; None
            without a sensor.
        lost_s: time for which the force has been below that of a contact, in a phase with contact.
        hidden_s: time for which the array has been saturated and the force is not known otherwise.
        off_pad_s: time for which a good part of the contact has been beyond the array's edge.
        bridged: share of the force that is interpolated over taxels which do not measure.
        bridged_s: time for which that share has been above `MAX_BRIDGED_SHARE`.
        path: the touch is a scan, which may search for a contact that it has lost.
        searched: distance towards the object that was searched since then, m.
        force_sigma: standard deviation of the force, N; infinite where the array shows only a lower bound of it.
        images: whether the images of the array live.
        depth: depth of the probe in the surface that it has touched before; None where nobody follows it.
    """

    limits: Limits
    force: float = 0.0
    tactile_age: int | None = None
    lost_s: float = 0.0
    hidden_s: float = 0.0
    off_pad_s: float = 0.0
    bridged: float = 0.0
    bridged_s: float = 0.0
    path: bool = False
    searched: float = 0.0
    force_sigma: float = 0.0
    images: ImageWitness = field(default_factory=ImageWitness)
    depth: DepthWitness | None = None
    _since_ns: dict[str, int] = field(default_factory=dict)

    @property
    def force_upper(self) -> float:
        """Upper end of the measured force, N; of a lower bound the bound itself, as its end is open."""
        return upper_end(self.force, self.force_sigma) if math.isfinite(self.force_sigma) else self.force

    def update_force(self, patch: Patch, t_ns: int, *, known: bool = False) -> None:
        """Take the patch of a tactile sample.

        Args:
            patch: patch that the sample shows.
            t_ns: time of the sample.
            known: the force is known where the array is saturated, too.
        """
        self.force, self.force_sigma = patch.force, patch.sigma.total
        felt = patch.force > TOUCH_FORCE / 2
        self.hidden_s = self._lasts_s("hidden", patch.saturated and not known, t_ns)
        self.off_pad_s = self._lasts_s("off pad", felt and patch.off_pad, t_ns)
        self.bridged = patch.bridged
        self.bridged_s = self._lasts_s("bridged", felt and patch.bridged > MAX_BRIDGED_SHARE, t_ns)

    def _lasts_s(self, what: str, holds: bool, t_ns: int) -> float:
        """Duration of the unbroken run of samples for which something holds, s."""
        if not holds:
            self._since_ns.pop(what, None)
            return 0.0
        return (t_ns - self._since_ns.setdefault(what, t_ns)) * 1e-9


class Reaction(Enum):
    """The reaction of the cell to a condition, the mildest first."""

    DEGRADE = "degrade"
    HOLD = "hold"
    SEARCH = "search"
    RETREAT = "retreat"
    LIFT = "lift off, quick stop"
    STOP = "quick stop"


@dataclass(frozen=True, slots=True)
class Condition:
    """One row of the table.

    Attributes:
        key: its name in code, tests and studies.
        what: the condition in words for users.
        reaction: reaction of the cell.
        within: longest time from the fault to the reaction, ns; None where no such time applies.
        check: function of a `CycleState` in every cycle, or of a `TouchState` in a touch; it returns the error that
            names what is wrong, or None. A condition without check and count shows by itself: a target beyond a
            limit, an exception, a dead master.
        count: function of a `CycleState`; it returns how often a condition that does not stop the cell has happened.
        touch: the check takes a `TouchState`.
        enabling: the check holds already while the drives are enabled.
        blind: the array is not believed any more: what it measures from then on is no force.
    """

    key: str
    what: str
    reaction: Reaction
    within: Callable[[Limits], int] | None
    check: Callable[[Any], CanprobeError | None] | None = None
    count: Callable[[CycleState], int] | None = None
    touch: bool = False
    enabling: bool = False
    blind: bool = False


@dataclass(frozen=True, slots=True)
class Finding:
    """A condition that holds, and the error that names what is wrong."""

    condition: Condition
    error: CanprobeError
