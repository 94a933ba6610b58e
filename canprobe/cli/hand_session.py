"""A cell that a person moves by hand: enabled after a word of theirs, held, moved, stopped, and shown meanwhile.

`HandSession` does what `console_words` reads from the lines that are typed. It takes them once a cycle while the drives
are enabled, without waiting; a motion goes on only while it is renewed, see `cell.tasks.guided_arm`.
"""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.master.controller import Measurement
from canprobe.cell.results.open_cell import OpenCell
from canprobe.cell.scene.rules import START
from canprobe.cell.session.up import homed_of
from canprobe.cell.tasks.guided_arm import LIFETIME_S, GuidedArm
from canprobe.cell.tasks.hand_motion import UNWANTED
from canprobe.cell.tasks.hand_way import USUAL_SPEED, HandWay, goal_of, jog_way, joint_way
from canprobe.cli.console_view import ConsoleView
from canprobe.cli.listen import array_line
from canprobe.cli.move import described, positions_of, standing
from canprobe.cli.posture_file import save_posture
from canprobe.cli.stdin import LOOK_S
from canprobe.errors import NodeError, ResultsError, SafetyStop, UsageError
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import nothing

SHOWN_S = 0.1
"""Time between two states that are shown, s."""
PLACES_A_CYCLE = 4
"""Places of a way to a posture that are looked at in a cycle: they take 0.1 ms."""
AXES = {name: (name[0] == "r", "xyz".index(name[-1])) for name in ("x", "y", "z", "rx", "ry", "rz")}
"""Axis of the probe by its name: whether it turns about it, and its number."""


class HandSession:
    """One cell that is moved by hand, from its bring-up on.

    Args:
        cell: the cell, not open yet.
        show: called with a line of text, and with the state of the cell, a JSON document, at least every `SHOWN_S`.
        cell_file: cell file into which postures are saved.
        paced: whether virtual time is no quicker than real time.

    Attributes:
        view: what is shown of the cell.
        take: called in each cycle; it calls the other methods.
        step: size of a step, deg or mm.
        speed: share of the speed limits.
        in_probe_frame: whether the axes are those of the probe.
        asked: the question that waits for an answer, and what is done after a yes; None without one.
        ended: whether the session is at its end.
    """

    def __init__(
        self, cell: OpenCell, show: Callable[[str | dict[str, Any]], None], cell_file: Path, *, paced: bool = True
    ) -> None:
        arm = cell.plan.setup.arm
        if arm is None:
            raise UsageError(f"console: {cell.plan.setup.name} has no arm; `canprobe listen` shows an array")
        self.view = ConsoleView(cell)
        self.take: Callable[[], None] = nothing
        self.step, self.speed, self.in_probe_frame = 1.0, USUAL_SPEED, False
        self.asked: tuple[str, Callable[[], None]] | None = None
        self.ended = False
        self._cell, self._plan, self._model, self._show, self._cell_file = cell, cell.plan, arm.model, show, cell_file
        self._taught: dict[str, Any] = {}
        self._paced, self._clock = paced and cell.session.virtual, MonotonicClock()
        self._behind_ns = self._shown_ns = 0
        self._arm = GuidedArm(cell.plan, self._attend)
        self._allowed = self._enables = self._enabled = self._moved = False
        self._stopped: str | None = None
        self._errands: list[Callable[[], None]] = []
        self._writes: list[Callable[[], None]] = []
        self._looks_at: HandWay | None = None
        self._way: HandWay | None = None
        self._jogs: tuple[str, int] | None = None
        self._held, self._renewed_ns = False, 0
        self._paused_at: float | None = None

    def run(self) -> None:
        """Do what `take` asks for until `end`; the cell is open."""
        self._show("the drives are disabled; `help` lists the commands, `enable` begins")
        cell, session = self._cell.cell, self._cell.session
        try:
            while not self.ended:
                if self._enables and not self._errands:
                    self._hold()
                while not self.ended and (waiting := self._errands or self._writes):
                    self.attempt(waiting.pop(0))
                self._attend(cell.idle(LOOK_S))
                if session.observers is not None:
                    session.observers.frames_alone(cell.port.clock.now_ns())
        finally:
            while self._writes:
                self.attempt(self._writes.pop(0))

    def attempt(self, action: Callable[[], None]) -> None:
        """Do something; what is wrong with it is shown, and a stop for safety asks for a `reset`."""
        try:
            action()
        except (SafetyStop, NodeError) as error:
            self._stop_for(error)
        except (UsageError, ResultsError, argparse.ArgumentTypeError) as error:
            self._show(str(error))

    # enabled and disabled

    def ready(self) -> bool:
        """Whether the drives are enabled; where they are not, a person is asked once, and they are soon.

        Raises:
            UsageError: the cell was stopped.
        """
        self._refuse_stopped()
        if not self._allowed:
            self._ask("nothing has moved in this session yet: is the arm free to move?", self._allow)
        else:
            self._enables = True
        return self._enabled

    def disable(self) -> None:
        """Let the motion brake, then disable the drives."""
        self._enables, self._arm.leaves = False, True

    def end(self) -> None:
        """End the session."""
        self.ended = True
        self.disable()

    def stop(self) -> None:
        """Quick stop."""
        self._arm.stop_reason = "quick stop, as was asked for"

    def reset(self) -> None:
        """Ask whether the arm may move again after a stop."""
        if self._stopped is None:
            raise UsageError("nothing was stopped")
        self._ask(f"stopped: {self._stopped}\nmay the arm move again? faults are reset", self._resume)

    def _hold(self) -> None:
        """Enable the drives, and hold and move the arm until they are to be disabled."""
        if (homing := self._cell.cell.homing) is not None and (unknown := set(homing.order) - homing.known):
            self._enables = False
            return self._show(f"joint {min(unknown) + 1} is not homed: type `home {min(unknown) + 1}`")
        self._arm = GuidedArm(self._plan, self._attend)
        self._enabled = True
        try:
            self._cell.run(self._arm)
        except (SafetyStop, NodeError) as error:
            self._stop_for(error)
        finally:
            self._enabled = self._moved = self._arm.moves = False
        if not self.ended:
            self._cell.cell.disable()
            self._show("the drives are disabled")

    def _stop_for(self, error: Exception) -> None:
        self._stopped = str(error)
        self._allowed = self._enables = False
        self.asked = self._paused_at = self._looks_at = None
        self._errands.clear()
        self._show(f"stopped: {error}")
        self._show("look at the arm; `reset` asks whether it may move again")

    def _refuse_stopped(self) -> None:
        if self._stopped is not None:
            raise UsageError("the cell was stopped; type `reset`")

    def _allow(self) -> None:
        self._allowed = self._enables = True

    def _resume(self) -> None:
        self._stopped = None
        with contextlib.suppress(UsageError):  # the drives could not be enabled, and nothing ran
            self._cell.resume()
        self._allow()

    def _ask(self, question: str, action: Callable[[], None]) -> None:
        self.asked = question, action
        self._show(f"{question} [yes, no]")

    # each cycle

    def _attend(self, measurement: Measurement) -> None:
        """Take what was typed, look further at a way, report the end of a motion, show the state."""
        self.view.look(measurement)
        self.take()
        if (way := self._looks_at) is not None:
            way.look(len(way.q) - 1 + PLACES_A_CYCLE)
            if way.looked_at or way.refused is not None:
                self._looks_at = None
                self.attempt(partial(self._propose, way))
        changed = self._moved != self._arm.moves
        if self._moved and changed:
            self._report_end()
        self._moved = self._arm.moves
        if changed or measurement.t_ns >= self._shown_ns:
            self._shown_ns = measurement.t_ns + round(1e9 * SHOWN_S)
            self._show(self._state())
        self._keep_pace()

    def _keep_pace(self) -> None:
        """Wait where virtual time is ahead of real time."""
        if self._paced:
            now_ns, t_ns = self._clock.now_ns(), self._cell.cell.port.clock.now_ns()
            self._behind_ns = max(self._behind_ns, now_ns - t_ns)  # time that computing took is not made up for
            self._clock.sleep_until_ns(t_ns + self._behind_ns)

    def _state(self) -> dict[str, Any]:
        moves, held = self._arm.moves, "holds" if self._enabled else "disabled"
        return self.view.document(self._arm.target if self._enabled else None) | {
            "state": "stopped" if self._stopped is not None else "moves" if moves else held,
            "asks": None if self.asked is None else self.asked[0],
            "step": self.step,
            "speed_percent": 100.0 * self.speed,
            "frame": "probe" if self.in_probe_frame else "base",
        }

    # motions

    def renew(self, *, goes_on: bool = False) -> None:
        """Renew a motion, unless it goes on by the repeats of a jog alone.

        Args:
            goes_on: go on with a motion that has paused.
        """
        self._renewed_ns = self._cell.cell.port.clock.now_ns()
        if not self._held:
            self._arm.renew()
        if goes_on and self._paused_at is not None and self._way is not None:
            self._go(self._way, begin=self._paused_at)

    def forget_pause(self) -> None:
        """Do not go on with a motion that has paused, nor look at a way any further."""
        self._paused_at = self._looks_at = None

    def jog(self, which: str, sign: int, *, repeated: bool) -> None:
        """Move a joint or the probe by a step, or on and on where the jog is repeated; a motion elsewhere brakes."""
        if which not in AXES and not which.isdecimal():
            raise UsageError(f"jog {which}: expected the number of a joint, or one of {', '.join(AXES)}")
        if not self.ready():
            return
        if self._arm.moves:
            if self._jogs == (which, sign):
                self._held = self._held or repeated
                self._arm.renew()
            else:
                self._arm.end_motion()
            return
        way = self._jog_way(which, sign, math.inf if repeated else self.step)
        if way.look(1.0) is not None or not way.length:
            raise UsageError(way.refused or f"joint {which} is at its limit")
        self._go(way, jogs=(which, sign), held=repeated)

    def _jog_way(self, which: str, sign: int, step: float) -> HandWay:
        turns, axis = AXES.get(which, (False, 0))
        direction = [float(i == axis) for i in range(3)]
        joint = None if which in AXES else int(which)
        slides = not turns if joint is None else joint <= self._model.n and self._model.joints[joint - 1].prismatic
        assert self._arm.target is not None
        return jog_way(
            self._plan,
            self._arm.target,
            joint,
            length=sign * step * (1e-3 if slides else math.radians(1.0)),
            speed=self.speed,
            along=direction if joint is None and not turns else None,
            about=direction if turns else None,
            in_probe_frame=self.in_probe_frame,
            guided=True,
        )

    def move(self, to: str) -> None:
        """Begin to look at the way to a posture."""
        if not self.ready():
            return
        if self._arm.moves:
            raise UsageError("the arm moves: wait, or type `stop`")
        assert self._arm.target is not None
        found = positions_of(self._plan, to)
        goal = self._taught[to] if to in self._taught else goal_of(self._plan, found)
        self._looks_at = joint_way(self._plan, self._arm.target, np.asarray(goal), self.speed, guided=True)

    def _propose(self, way: HandWay) -> None:
        """Show a way to a posture, and ask."""
        if not way.whole().length:
            raise UsageError("the arm stands there")
        text = described(self._plan, way, self.speed)
        self._ask(f"{text}\nmove? it goes on while Enter is held, or the screen is there", partial(self._go, way))

    def _go(self, way: HandWay, *, begin: float = 0.0, jogs: tuple[str, int] | None = None, held: bool = False) -> None:
        self._way, self._jogs, self._held, self._paused_at = way, jogs, held, None
        self._arm.go(way, begin)

    def _report_end(self) -> None:
        motion = self._arm.motion
        assert motion is not None
        if motion.ended_by is None and self._jogs is None:
            self._show(f"the arm stands at {standing(self._plan, self.view.seen)}")
        elif motion.ended_by not in (None, UNWANTED):
            self._show(f"the motion has ended: {motion.ended_by}")
        elif motion.ended_by is not None and not self._held and not self._arm.leaves:
            self._paused_at = motion.place
            self._show(f"paused, as nobody has renewed the motion for {1e3 * LIFETIME_S:.0f} ms: Enter goes on")

    def teach(self, name: str) -> None:
        """Save the posture in which the arm stands; the file is written when the drives are disabled."""
        if name == START:
            raise UsageError(f"{name} is what the joints have as start_deg or start_mm; choose another name")
        q = self.view.seen.q
        assert q is not None
        self._taught[name] = q
        text = f"{name} is {standing(self._plan, self.view.seen)}"
        if not self._cell_file.is_file():
            packaged = f"{self._cell_file} is packaged, `canprobe init` makes a file of it"
            return self._show(f"{text}, until the end of this session: {packaged}")
        posture = [round(its.shown(value), 4) for its, value in zip(self._model.joints, q, strict=True)]
        self._writes.append(partial(save_posture, self._cell_file, name, posture))
        self._show(f"{text}; it is written into {self._cell_file} when the drives are disabled")

    # errands, with the drives disabled

    def tare(self) -> None:
        """Ask, then take what the array shows for zero."""
        self._ask_first("is the array free, and may this be zero?", self._tare)

    def home(self, joint: int) -> None:
        """Ask, then home a joint."""
        axis, homing = homed_of(self._plan, [joint])[0], self._cell.cell.homing
        assert homing is not None
        self._ask_first(homing.question(axis), partial(self._home, joint))

    def _ask_first(self, question: str, errand: Callable[[], None]) -> None:
        """Ask before an errand, for which the drives are disabled."""
        self._refuse_stopped()

        def leave() -> None:
            self._errands.append(errand)
            self._arm.leaves = True

        self._ask(question, leave)

    def _tare(self) -> None:
        self._cell.tare()
        self.view.look(self._cell.read())
        self._show(f"tared: {array_line(self._cell, self.view.imaged)}")

    def _home(self, joint: int) -> None:
        homing = self._cell.cell.homing
        assert homing is not None
        self._arm.stop_reason, homing.link.attend = None, self._attend_homing
        self.renew()
        try:
            self._cell.home([joint])
        finally:
            homing.link.attend = nothing
        self._show(f"joint {joint} is homed")

    def _attend_homing(self) -> None:
        """Stop the drive that is homed where somebody says so, or nobody renews it."""
        self._keep_pace()
        self.take()
        if self._arm.stop_reason is not None or self.ended:
            raise SafetyStop(self._arm.stop_reason or "the input has ended")
        if self._cell.cell.port.clock.now_ns() - self._renewed_ns > 1e9 * LIFETIME_S:
            raise SafetyStop(f"homing was not renewed for {1e3 * LIFETIME_S:.0f} ms")

    def where(self) -> None:
        """Show joints and force."""
        self._show(standing(self._plan, self.view.seen))
        if self.view.imaged.tactile is not None:
            self._show(array_line(self._cell, self.view.imaged))
