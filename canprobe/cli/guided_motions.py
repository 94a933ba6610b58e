"""The motions of a console: jogs, and ways to postures, which a person renews; see `cell.tasks.guided_arm`."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from canprobe.cell.master.controller import Measurement
from canprobe.cell.results.open_cell import OpenCell
from canprobe.cell.tasks.guided_arm import LIFETIME_S, GuidedArm
from canprobe.cell.tasks.hand_motion import UNWANTED
from canprobe.cell.tasks.hand_way import HandWay, Jog, goal_of, jog_way, joint_way
from canprobe.cell.tasks.task import USUAL_SPEED
from canprobe.cli.console_view import ConsoleView
from canprobe.cli.hand_questions import Questions
from canprobe.cli.move import described, positions_of, standing
from canprobe.errors import UsageError

PLACES_A_CYCLE = 4
"""Places of a way to a posture that are looked at in a cycle: they take 0.1 ms."""
AXES = {name: (name[0] == "r", "xyz".index(name[-1])) for name in ("x", "y", "z", "rx", "ry", "rz")}
"""Axis of the probe by its name: whether it turns about it, and its number."""


class GuidedMotions:
    """Begins motions of an arm that is held, and says how they end.

    Args:
        cell: a cell with an arm.
        view: what was measured last.
        questions: what a person has allowed, and is told.
        attend: called in each cycle in which the arm is held.

    Attributes:
        step: size of a step, deg or mm.
        speed: share of the speed limits.
        in_probe_frame: whether the axes are those of the probe.
        taught: joint positions (n,), rad or m, by the names that they were given in this session.
        arm: the arm; only its `stop_reason` is read while it is not held.
        enabled: whether it is held.
        renewed_ns: time of the last renewal, ns on the clock of the bus.
    """

    def __init__(
        self, cell: OpenCell, view: ConsoleView, questions: Questions, attend: Callable[[Measurement], None]
    ) -> None:
        self._cell, self._plan, self._joints = cell, cell.plan, cell.plan.setup.needed_arm().model.joints
        self.view, self.questions, self._show, self._attend = view, questions, questions.show, attend
        self.step, self.speed, self.in_probe_frame = 1.0, USUAL_SPEED, False
        self.taught: dict[str, Any] = {}
        self.arm = GuidedArm(cell.plan, attend)
        self.enabled = self._moved = self._held = False
        self.renewed_ns = 0
        self._looks_at: HandWay | None = None
        self._way: HandWay | None = None
        self._jogs: tuple[str, int] | None = None
        self._paused_at: float | None = None

    def hold(self) -> None:
        """Enable the drives, and hold and move the arm until it leaves.

        Raises:
            SafetyStop, NodeError: the cell was stopped.
        """
        self.arm = GuidedArm(self._plan, self._attend, self._read)
        self.enabled = True
        try:
            self._cell.run(self.arm)
        finally:
            self.enabled = self._moved = self.arm.moves = False

    def _read(self) -> None:
        self._cell.cell.readings.serve(begins=not self.arm.leaves)

    def look(self) -> None:
        """Look further at a way, and report the end of a motion; called in each cycle.

        Raises:
            UsageError: the way may not be gone.
        """
        moved, self._moved = self._moved, self.arm.moves
        if moved and not self._moved:
            self._report_end()
        if (way := self._looks_at) is not None:
            way.look(len(way.q) - 1 + PLACES_A_CYCLE)
            if way.looked_at or way.refused is not None:
                self._looks_at = None
                self._propose(way)

    def renew(self, *, goes_on: bool = False) -> None:
        """Renew a motion, unless it goes on by the repeats of a jog alone.

        Args:
            goes_on: go on with a motion that has paused.
        """
        self.renewed_ns = self._cell.cell.port.clock.now_ns()
        if not self._held:
            self.arm.renew()
        if goes_on and self._paused_at is not None and self._way is not None:
            self._go(self._way, begin=self._paused_at)

    def forget_pause(self) -> None:
        """Do not go on with a motion that has paused, nor look at a way any further."""
        self._paused_at = self._looks_at = None

    def jog(self, which: str, sign: int, *, repeated: bool) -> None:
        """Move a joint or the probe by a step, or on and on where the jog is repeated; a motion elsewhere brakes."""
        if which not in AXES and not which.isdecimal():
            raise UsageError(f"jog {which}: expected the number of a joint, or one of {', '.join(AXES)}")
        if not self._ready():
            return
        if self.arm.moves:
            if self._jogs == (which, sign):
                self._held = self._held or repeated
                self.arm.renew()
            else:
                self.arm.end_motion()
            return
        way = self._jog_way(which, sign, math.inf if repeated else self.step)
        if way.look(1.0) is not None or not way.length:
            raise UsageError(way.refused or f"joint {which} is at its limit")
        self._go(way, jogs=(which, sign), held=repeated)

    def _ready(self) -> bool:
        """Whether the drives are enabled; where they are not, they are to be."""
        self.questions.enable()
        return self.enabled

    def _jog_way(self, which: str, sign: int, step: float) -> HandWay:
        turns, axis = AXES.get(which, (False, 0))
        direction = [float(i == axis) for i in range(3)]
        joint = None if which in AXES else int(which)
        slides = not turns if joint is None else joint <= len(self._joints) and self._joints[joint - 1].prismatic
        along, about = (None, direction) if turns else (direction if joint is None else None, None)
        length = sign * step * (1e-3 if slides else math.radians(1.0))
        assert self.arm.target is not None
        jog = Jog(joint, along, about, self.in_probe_frame)
        return jog_way(self._plan, self.arm.target, jog, length, self.speed, guided=True)

    def move(self, to: str) -> None:
        """Begin to look at the way to a posture."""
        if not self._ready():
            return
        if self.arm.moves:
            raise UsageError("the arm moves: wait, or type `stop`")
        assert self.arm.target is not None
        found = positions_of(self._plan, to)
        goal = self.taught[to] if to in self.taught else goal_of(self._plan, found)
        self._looks_at = joint_way(self._plan, self.arm.target, np.asarray(goal), self.speed, guided=True)

    def _propose(self, way: HandWay) -> None:
        """Show a way to a posture, and ask."""
        if not way.whole().length:
            raise UsageError("the arm stands there")
        text = described(self._plan, way, self.speed)
        self.questions.ask(
            f"{text}\nmove? it goes on while Enter is held, or the screen is there", partial(self._go, way)
        )

    def _go(self, way: HandWay, *, begin: float = 0.0, jogs: tuple[str, int] | None = None, held: bool = False) -> None:
        self._way, self._jogs, self._held, self._paused_at = way, jogs, held, None
        self.arm.go(way, begin)

    def _report_end(self) -> None:
        motion = self.arm.motion
        assert motion is not None
        if motion.ended_by is None and self._jogs is None:
            self._show(f"the arm stands at {standing(self._plan, self.view.seen)}")
        elif motion.ended_by not in (None, UNWANTED):
            self._show(f"the motion has ended: {motion.ended_by}")
        elif motion.ended_by is not None and not self._held and not self.arm.leaves:
            self._paused_at = motion.place
            self._show(f"paused, as nobody has renewed the motion for {1e3 * LIFETIME_S:.0f} ms: Enter goes on")
