"""What every task that touches with the probe has: a phase, the probe's motion, and what it says in each cycle."""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.hidden_force import HiddenForce
from canprobe.cell.measurement import Command, TactileSample
from canprobe.cell.supervision import Limits
from canprobe.cell.tasks.probe_motion import ProbeMotion
from canprobe.cell.tasks.sensing import ContactSensing
from canprobe.touch.contact import ContactSample
from canprobe.touch.patch import Patch
from canprobe.touch.servo import ProbePose

if TYPE_CHECKING:
    from canprobe.touch.estimate import SurfaceEstimate

Vector = NDArray[np.float64]
CYCLES_TO_EFFECT = 2
"""From a SYNC to the moment its command begins to take effect, behind which the drives lag."""
LONGEST_STEP = 4
"""Periods that one command makes up for at most after an overrun; the rest of a longer stall is lost time."""


class Phase(IntEnum):
    """Phases of a touch task, in their order; a scan that loses its contact goes to and fro between it and REGAIN."""

    MOVE = 0
    APPROACH = 1
    SETTLE = 2
    SCAN = 3
    RETREAT = 4
    DONE = 5
    REGAIN = 6


class ProbingTask:
    """Base of the tasks that touch.

    Args:
        lag_s: of the drives behind a ramp.
        limits: of the cell; beyond them the probe retreats and the cell stops.
        sensing: contacts from measurements.
        motion_from: makes the probe's motion from the first joint angles.

    Attributes:
        phase: what it is about.
        reason: why it stopped; None while all is well.
        taxels: last image of the touch itself.
    """

    def __init__(
        self,
        lag_s: float,
        limits: Limits,
        sensing: ContactSensing,
        motion_from: Callable[[Vector], ProbeMotion],
    ) -> None:
        self.phase = Phase.MOVE
        self.sensing = sensing
        self.reason: str | None = None
        self.taxels: NDArray[np.uint8] | None = None
        self._limits = limits
        period_s = limits.period_ns * 1e-9
        self._lead_s = CYCLES_TO_EFFECT * period_s + lag_s
        self._motion_from = motion_from
        self._motion: ProbeMotion | None = None
        self._period_s = self._dt = period_s
        self._last_ns: int | None = None
        self._t = 0.0
        self._force = 0.0
        self._hidden, self._off_pad = HiddenForce(), HiddenForce()
        self._columns: dict[str, float | Vector] = {}

    @property
    def unplaced(self) -> int:
        """Contacts that were not used because the joints of their instant are unknown."""
        return self.sensing.dropped

    @property
    def slowed(self) -> int:
        """Cycles in which a joint could not keep up with the probe's path."""
        return self._motion.slowed if self._motion is not None else 0

    def retreat(self, reason: str) -> None:
        """Let go and end for a reason that the cell has."""
        raise NotImplementedError

    def _pass_time(self, t_ns: int) -> None:
        """Where an overrun has swallowed cycles the motion goes on by the time that has passed, within a bound."""
        passed = self._period_s if self._last_ns is None else (t_ns - self._last_ns) * 1e-9
        self._last_ns = t_ns
        self._dt = min(passed, LONGEST_STEP * self._period_s)

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._t = 0.0

    def _done(self) -> ProbePose:
        assert self._motion is not None
        return self._motion.pose

    def _command(self, pose: ProbePose, estimate: SurfaceEstimate | None = None) -> Command:
        """One step of the probe to a pose, as the cell takes it; a joint's limit on the way makes the task let go."""
        assert self._motion is not None
        target = self._motion.step(pose)
        if self._motion.limit is not None:
            self.retreat(self._motion.limit)
        self._columns["phase"] = float(self.phase)
        done = self.phase is Phase.DONE
        return Command(
            q_target=target,
            done=done and self.reason is None,
            stop_reason=self.reason if done else None,
            columns=self._columns,
            estimate=estimate,
        )

    def _felt_columns(
        self, sample: TactileSample, patch: Patch, contact: ContactSample | None
    ) -> dict[str, float | Vector]:
        """What an image says, for the log."""
        nothing = np.full(3, np.nan)
        return {
            "phase": float(self.phase),
            "sample_cycle": float(sample.cycle),
            "force_n": patch.force,
            "pad_u_mm": patch.u * 1e3,
            "pad_v_mm": patch.v * 1e3,
            "contact_mm": contact.p_base * 1e3 if contact is not None else nothing,
            "normal": contact.n_base if contact is not None else nothing,
        }
