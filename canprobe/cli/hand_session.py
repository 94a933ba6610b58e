"""A cell that a person moves by hand: enabled after a word of theirs, held, moved, stopped, and shown meanwhile.

`HandSession` does what `console_words` reads from the lines that are typed. It takes them once a cycle while the drives
are enabled, without waiting; a motion goes on only while it is renewed, see `cell.tasks.guided_arm`.
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from canprobe.cell.master.controller import Measurement
from canprobe.cell.results.open_cell import OpenCell
from canprobe.cli.console_view import ConsoleView
from canprobe.cli.guided_motions import GuidedMotions
from canprobe.cli.hand_errands import Errands
from canprobe.cli.hand_questions import Questions
from canprobe.cli.listen import array_line
from canprobe.cli.move import standing
from canprobe.cli.stdin import LOOK_S
from canprobe.errors import NodeError, ResultsError, SafetyStop, UsageError
from canprobe.fieldbus.bus.clock import Pace
from canprobe.fieldbus.bus.port import nothing

SHOWN_S = 0.1
"""Time between two states that are shown, s."""


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
            self._stop_for(error)
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

    def _stop_for(self, error: Exception) -> None:
        self.questions.stop(str(error))
        self.motions.forget_pause()
        self.errands.waiting.clear()
        self._show(f"stopped: {error}")
        self._show("look at the arm; `reset` asks whether it may move again")

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
