"""The errands of a console: what is done with the drives disabled, in between: tare, home, write postures."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from canprobe.cell.results.open_cell import OpenCell
from canprobe.cell.scene.rules import START
from canprobe.cell.session.up import homed_of
from canprobe.cell.tasks.guided_arm import LIFETIME_S
from canprobe.cli.guided_motions import GuidedMotions
from canprobe.cli.listen import array_line
from canprobe.cli.move import standing
from canprobe.cli.posture_file import save_posture
from canprobe.errors import SafetyStop, UsageError
from canprobe.fieldbus.bus.port import nothing


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
