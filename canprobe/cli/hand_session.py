"""A cell that a person moves by hand: enabled after a word of theirs, held, moved, stopped, and shown meanwhile.

`HandSession` does what `console_words` reads from the lines that are typed. It takes them once a cycle while the drives
are enabled, without waiting; a motion goes on only while it is renewed, see `cell.tasks.guided_arm`. What needs them
disabled, to tare, to home and to write postures, is an errand, done in between.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from canprobe.cell.master.controller import Measurement
from canprobe.cell.results.open_cell import OpenCell
from canprobe.cell.scene.rules import START
from canprobe.cell.session.up import homed_of
from canprobe.cell.tasks.guided_arm import LIFETIME_S
from canprobe.cli.console_view import ConsoleView
from canprobe.cli.guided_motions import GuidedMotions
from canprobe.cli.hand_questions import Questions
from canprobe.cli.listen import array_line
from canprobe.cli.move import standing
from canprobe.cli.posture_file import save_posture
from canprobe.cli.stdin import LOOK_S
from canprobe.errors import NodeError, ResultsError, SafetyStop, UsageError
from canprobe.fieldbus.bus.clock import Pace
from canprobe.fieldbus.bus.port import nothing

SHOWN_S = 0.1
"""Time between two states that are shown, s."""


class Errands:
    """Asks for errands, and does them when the drives are disabled.

    Args:
        cell: a cell with an arm.
        motions: motions of the arm; it is not held during an errand.
        attend: called while a drive is homed.
        cell_file: cell file into which postures are saved.

    Attributes:
        waiting: errands that a person has agreed to, in their order.
        writes: postures that wait to be written; they stay after a stop.
    """

    def __init__(self, cell: OpenCell, motions: GuidedMotions, attend: Callable[[], None], cell_file: Path) -> None:
        self._cell, self._motions, self._attend, self._cell_file = cell, motions, attend, cell_file
        self._view, self._questions, self._show = motions.view, motions.questions, motions.questions.show
        self.waiting: list[Callable[[], None]] = []
        self.writes: list[Callable[[], None]] = []

    def teach(self, name: str) -> None:
        """Save the posture in which the arm stands; the file is written when the drives are disabled."""
        if name == START:
            raise UsageError(f"{name} is what the joints have as start_deg or start_mm; choose another name")
        q = self._view.seen.q
        assert q is not None
        self._motions.taught[name] = q
        text = f"{name} is {standing(self._cell.plan, self._view.seen)}"
        if not self._cell_file.is_file():
            packaged = f"{self._cell_file} is packaged, `canprobe init` makes a file of it"
            return self._show(f"{text}, until the end of this session: {packaged}")
        joints = self._cell.plan.setup.needed_arm().model.joints
        self.writes.append(partial(save_posture, self._cell_file, name, joints, q))
        self._show(f"{text}; it is written into {self._cell_file} when the drives are disabled")

    def tare(self) -> None:
        """Ask, then take what the array shows for zero."""
        self._ask_first("is the array free, and may this be zero?", self._tare)

    def home(self, joint: int) -> None:
        """Ask, then home a joint."""
        axis, homing = homed_of(self._cell.plan, [joint])[0], self._cell.cell.homing
        assert homing is not None
        self._ask_first(homing.question(axis), partial(self._home, joint))

    def _ask_first(self, question: str, errand: Callable[[], None]) -> None:
        """Ask before an errand, for which the drives are disabled."""
        self._questions.refuse_stopped()

        def leave() -> None:
            self.waiting.append(errand)
            self._motions.arm.leaves = True

        disables = f"{self._questions.left_alone}\n" if self._motions.enabled else ""
        self._questions.ask(f"{disables}{question}", leave)

    def _tare(self) -> None:
        self._cell.tare()
        self._view.look(self._cell.read())
        self._show(f"tared: {array_line(self._cell, self._view.imaged)}")

    def _home(self, joint: int) -> None:
        homing = self._cell.cell.homing
        assert homing is not None
        self._motions.arm.stop_reason, homing.link.attend = None, self._attend_homing
        self._motions.renew()
        try:
            self._cell.home([joint])
        finally:
            homing.link.attend = nothing
        self._show(f"joint {joint} is homed")

    def _attend_homing(self) -> None:
        """Stop the drive that is homed where somebody says so, or nobody renews it."""
        self._attend()
        if (why := self._motions.arm.stop_reason) is not None:
            raise SafetyStop(why)
        if self._cell.cell.port.clock.now_ns() - self._motions.renewed_ns > 1e9 * LIFETIME_S:
            raise SafetyStop(f"homing was not renewed for {1e3 * LIFETIME_S:.0f} ms")


class HandSession:
    """One cell that is moved by hand, from its bring-up on.

    Args:
        cell: the cell, not open yet.
        show: called with a line of text, and with the state of the cell, a JSON document, at least every `SHOWN_S`.
        cell_file: cell file into which postures are saved.
        paced: whether virtual time is no quicker than real time.

    Attributes:
        view: what is shown of the cell.
        questions, motions, errands: what `take` has the session do.
        take: called in each cycle; it calls the methods of the session and of these.
        ended: whether the session is at its end.
    """

    def __init__(
        self, cell: OpenCell, show: Callable[[str | dict[str, Any]], None], cell_file: Path, *, paced: bool = True
    ) -> None:
        if (arm := cell.plan.setup.arm) is None:
            raise UsageError(f"console: {cell.plan.setup.name} has no arm; `canprobe listen` shows an array")
        self.view, self.questions = ConsoleView(cell), Questions(arm.left_alone, show, self._resume)
        self.motions = GuidedMotions(cell, self.view, self.questions, self._attend)
        self.errands = Errands(cell, self.motions, self._attend_homing, cell_file)
        self.take: Callable[[], None] = nothing
        self.ended = False
        self._cell, self._show = cell, show
        self._pace = Pace() if paced and cell.session.virtual else None
        self._shown_ns = 0
        self._shown = ""

    def run(self) -> None:
        """Do what `take` asks for until `end`; the cell is open."""
        self._show("the drives are disabled; `help` lists the commands, `enable` begins")
        cell, session, errands = self._cell.cell, self._cell.session, self.errands
        try:
            while not self.ended:
                if self.questions.enables and not errands.waiting:
                    self._hold()
                while not self.ended and (waiting := errands.waiting or errands.writes):
                    self.attempt(waiting.pop(0))
                self._attend(cell.idle(LOOK_S))
                cell.readings.serve(begins=not (self.questions.enables or errands.waiting))
                if session.observers is not None:
                    session.observers.frames_alone(cell.port.clock.now_ns())
        finally:
            while errands.writes:
                self.attempt(errands.writes.pop(0))

    def attempt(self, action: Callable[[], None]) -> None:
        """Do something; what is wrong with it is shown, and a stop for safety asks for a `reset`."""
        try:
            action()
        except (SafetyStop, NodeError) as error:
            self.questions.stop(str(error))
            self.motions.forget_pause()
            self.errands.waiting.clear()
            self._show(f"stopped: {error}")
            self._show("look at the arm; `reset` asks whether it may move again")
        except (UsageError, ResultsError, argparse.ArgumentTypeError) as error:
            self._show(str(error))

    def disable(self) -> None:
        """Let the motion brake, then disable the drives."""
        self.questions.enables, self.motions.arm.leaves = False, True

    def end(self) -> None:
        """End the session."""
        self.ended = True
        self.disable()

    def stop(self) -> None:
        """Quick stop."""
        self.motions.arm.stop_reason = "quick stop, as was asked for"

    def where(self) -> None:
        """Show joints and force."""
        self._show(standing(self._cell.plan, self.view.seen))
        if self.view.imaged.tactile is not None:
            self._show(array_line(self._cell, self.view.imaged))

    def _hold(self) -> None:
        """Hold and move the arm until its drives are to be disabled."""
        if (homing := self._cell.cell.homing) is not None and (unknown := set(homing.order) - homing.known):
            self.questions.enables = False
            return self._show(f"joint {min(unknown) + 1} is not homed: type `home {min(unknown) + 1}`")
        self.attempt(self.motions.hold)
        if not self.ended:
            self._cell.cell.disable()
            self._show("the drives are disabled")

    def _resume(self) -> None:
        with contextlib.suppress(UsageError):  # the drives could not be enabled, and nothing ran
            self._cell.resume()

    def _attend(self, measurement: Measurement) -> None:
        """Take what was typed, go on with what was begun, show the state; called in each cycle."""
        self.view.look(measurement)
        self.take()
        self.attempt(self.motions.look)
        while remarks := self._cell.cell.readings.remarks:
            self._show(remarks.pop(0))
        state = self._state
        if state != self._shown or measurement.t_ns >= self._shown_ns:
            self._shown, self._shown_ns = state, measurement.t_ns + round(1e9 * SHOWN_S)
            self._show(self._document(state))
        self._keep_pace()

    def _attend_homing(self) -> None:
        self._keep_pace()
        self.take()
        if self.ended:
            raise SafetyStop("the input has ended")

    def _keep_pace(self) -> None:
        """Wait where virtual time is ahead of real time."""
        if self._pace is not None:
            self._pace.keep(self._cell.cell.port.clock.now_ns())

    @property
    def _state(self) -> str:
        if self.questions.stopped is not None:
            return "stopped"
        return "moves" if self.motions.arm.moves else "holds" if self.motions.enabled else "disabled"

    def _document(self, state: str) -> dict[str, Any]:
        asked, motions = self.questions.asked, self.motions
        return self.view.document(motions.arm.target if motions.enabled else None) | {
            "state": state,
            "asks": None if asked is None else asked[0],
            "step": motions.step,
            "speed_percent": 100.0 * motions.speed,
            "frame": "probe" if motions.in_probe_frame else "base",
        }
