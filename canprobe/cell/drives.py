"""The six drives as one thing: TPDOs in, joint angles out; joint targets in, RPDOs out.

The drives hold *motor* positions; the wrist's coupling is undone here and nowhere else.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.protocol.cia402 import DriveState, controlword_toward, state_of
from canprobe.protocol.frames import Frame
from canprobe.protocol.pdo import PdoLayout
from canprobe.robot.puma260 import PumaModel, counts_to_joints, joints_to_counts

Vector = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DriveAxis:
    """One drive's place on the bus.

    Attributes:
        node_id: the node.
        feedback: layout of its TPDO: statusword, position (counts), torque (permille).
        command: layout of its RPDO: controlword, target position (counts).
    """

    node_id: int
    feedback: PdoLayout
    command: PdoLayout


class DriveGroup:
    """State of six CiA 402 drives in cyclic synchronous position mode.

    Args:
        axes: the drives, joint 1 first.
        model: the arm, for counts ↔ joint angles.
    """

    def __init__(self, axes: tuple[DriveAxis, ...], model: PumaModel) -> None:
        self.axes = axes
        self.goal = DriveState.OPERATION_ENABLED
        self.statuswords = [0] * len(axes)
        self.torque_permille = [0] * len(axes)
        self.late = 0
        self.missed = 0
        self._model = model
        self._axis_of = {axis.feedback.cob_id: i for i, axis in enumerate(axes)}
        self._counts = [0] * len(axes)
        self._heard = [-1] * len(axes)
        self._targets: list[int] | None = None
        self._pending = 0
        self._open = False
        self._cycle = -1

    @property
    def feedback_ids(self) -> frozenset[int]:
        """COB-IDs of the TPDOs that belong to the group."""
        return frozenset(self._axis_of)

    def begin(self, cycle: int) -> None:
        """A new SYNC is out: every TPDO is expected once more."""
        self._cycle = cycle
        self._pending = len(self.axes)
        self._open = True

    @property
    def complete(self) -> bool:
        """Every TPDO of this cycle is in."""
        return self._pending == 0

    def push(self, can_id: int, data: bytes) -> None:
        """Take one TPDO; one outside the collection window, or a second one for the same SYNC, is late and not used."""
        i = self._axis_of[can_id]
        if not self._open or self._heard[i] == self._cycle:
            self.late += 1
            return
        self.statuswords[i], self._counts[i], self.torque_permille[i] = self.axes[i].feedback.unpack(data)
        self._heard[i] = self._cycle
        self._pending -= 1

    def end_collect(self) -> None:
        """The collection window of this cycle is over: what is not in is missed."""
        self.missed += self._pending
        self._open = False

    @property
    def heard_all(self) -> bool:
        """Every drive was heard at least once."""
        return min(self._heard) >= 0

    def ages(self) -> tuple[int, ...]:
        """Cycles since each drive was last heard."""
        return tuple(self._cycle - heard for heard in self._heard)

    def joints(self) -> Vector:
        """Joint angles (6,), rad, as last reported."""
        return counts_to_joints(self._model, np.array(self._counts, dtype=float))

    @property
    def states(self) -> tuple[DriveState, ...]:
        """CiA 402 state of each drive, from its last statusword."""
        return tuple(state_of(word) for word in self.statuswords)

    def all_in(self, *states: DriveState) -> bool:
        """Every drive is in one of ``states``."""
        return all(state in states for state in self.states)

    def set_target(self, q: Vector | None) -> None:
        """Joint target (6,), rad, of the next RPDOs; None holds the last one."""
        if q is not None:
            self._targets = [round(c) for c in joints_to_counts(self._model, q).tolist()]

    def frames(self) -> list[Frame]:
        """The RPDOs of this cycle; until a target is set, a drive is told to stay where it reported to be."""
        targets = self._targets if self._targets is not None else self._counts
        return [
            (axis.command.cob_id, axis.command.pack(controlword_toward(state, self.goal), target))
            for axis, state, target in zip(self.axes, self.states, targets, strict=True)
        ]
