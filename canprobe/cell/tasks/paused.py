"""A task in a cell that has come back from a loss: it holds the arm where it stands until motion is asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from canprobe.cell.master.controller import Command, Controller, Measurement, WrappingController
from canprobe.cell.master.trail import TakenWay
from canprobe.mechanics.robot.model import Joint
from canprobe.mechanics.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class LastPlace:
    """Where an arm stood before its cell was lost.

    Attributes:
        joints: joints of the arm.
        q: joint positions as last reported (n,), rad or m.
        tolerance: difference (n,) that a drive which braked by itself can make, rad or m.
    """

    joints: Sequence[Joint]
    q: Floats
    tolerance: Floats

    def difference(self, q: Floats) -> str | None:
        """Why the arm at joint positions (n,), rad or m, does not stand where it stood; None where it does.

        An encoder cannot say whether the arm was moved without power, or reports another zero since.
        """
        beyond = np.flatnonzero(np.abs(q - self.q) > self.tolerance)
        if not beyond.size:
            return None
        i = int(beyond[0])
        joint = self.joints[i]
        return (
            f"joint {i + 1} reports {joint.text(q[i], '.2f')}, and reported {joint.text(self.q[i], '.2f')} before the"
            " loss: it was moved without power, or its zero is elsewhere now; nothing is enabled. Compare the arm with"
            " its marks, then bring the cell up anew"
        )


class PausedController(WrappingController):
    """Holds the arm until motion is asked for, then steps another controller.

    Args:
        controller: the controller that goes on.
        place: where the arm has to stand; None without an arm.
        asked: whether motion is asked for; None: the controller is new, and begins at once.
        resumed: called when motion is asked for.
    """

    def __init__(
        self,
        controller: Controller,
        place: LastPlace | None,
        asked: Callable[[], bool] | None,
        resumed: Callable[[], None] = lambda: None,
    ) -> None:
        self.inner: Controller = controller
        self._place = place
        self._asked, self._resumed = asked, resumed
        self.held = asked is not None
        self._begun = False

    def inspect(self, q: Floats) -> str | None:
        """Refuse an arm that stands elsewhere than before the loss."""
        elsewhere = self._place.difference(q) if self._place is not None else None
        return elsewhere if elsewhere is not None else self.inner.inspect(q)

    def step(self, measurement: Measurement) -> Command:
        if self.held:
            assert self._asked is not None
            wanted = self.inner.asks_to_go_on()  # which also drops what was asked of it during the hold
            before, self._begun = not self._begun, True  # what was asked for before the hold does not count
            if before or not (self._asked() or wanted):
                return Command()
            self.held = False
            self.inner.go_on(measurement)
            self._resumed()
        return self.inner.step(measurement)

    def update(self) -> None:
        if not self.held:
            self.inner.update()

    @property
    def retreats_itself(self) -> bool:  # type: ignore[override]
        """Whether the controller lets go by itself; in the hold the cell does."""
        return not self.held and self.inner.retreats_itself

    @property
    def trail(self) -> TakenWay | None:
        """The way by which the controller's probe has come; after a hold it is not known."""
        return None if self.held else self.inner.trail
