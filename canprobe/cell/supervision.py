"""What can go wrong in a running cell: one row a condition, with its check, its time, its reaction and the way back.

The table `CONDITIONS` drives the checks of :class:`canprobe.cell.supervisor.Supervisor` and of the touch tasks, and
docs/supervision.md has it (`canprobe.cell.supervision_text`). What a check needs is in `Seen`; `Limits` follows from
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
from canprobe.cell.drives import DriveGroup
from canprobe.cell.measurement import Measurement
from canprobe.cell.tactile import TactileReceiver
from canprobe.cell.watch import NodeWatch
from canprobe.errors import CanprobeError

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
        joint_low, joint_high: range of the joint targets (6,), rad; None without an arm.
        joint_speed: speed limits (6,), rad/s.
        count: joint angle of one encoder count (6,), rad.
        workspace: lowest and highest position (2, 3) of the probe's tip, m, base frame; None without one.
        T_base_tip_of: transform (4, 4) from the probe's tip (z = pole, towards the object) to base, of joint angles
            (6,), rad; None without an arm.
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
