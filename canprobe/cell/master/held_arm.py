"""An arm that is held and goes on: joint targets during a hold, and after it."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from canprobe.cell.master.controller import Command, Measurement
from canprobe.mechanics.types import Floats

KEPT = 40
"""Targets that are kept: as many as an arm may lag behind."""
THAW_NS = 50_000_000
"""Time in which the targets go on from where the arm was held to where its controller is."""


class HeldArm:
    """Holds an arm where it is: its last targets lie ahead of it, and the drives that are heard would go on to them.

    In the first cycle of a hold they do: it is often the only one, and to stop and go on for it presses harder. Where
    the arm is then says the target that the heard joints have come nearest to: the place of an unheard one is a guess.

    Attributes:
        holds: whether the last cycle was one of a hold.
    """

    def __init__(self) -> None:
        self.holds = False
        self._sent: deque[Floats] = deque(maxlen=KEPT)
        self._frozen: Floats | None = None
        self._behind: Floats | None = None
        self._thawed_ns = 0

    def freeze(self, measurement: Measurement) -> Command:
        """The command of a cycle of the hold: from the second one on, where the arm was in that."""
        if self.holds and self._frozen is None:
            self._frozen = self._place(measurement)
        self.holds = True
        return Command(self._frozen)

    def _place(self, measurement: Measurement) -> Floats | None:
        heard = [not age for age in measurement.q_age]
        q = measurement.q
        if q is None or all(heard) or not any(heard) or not self._sent:
            return q
        return min(self._sent, key=lambda target: float(np.abs(target - q)[heard].max()))

    def thaw(self, command: Command, measurement: Measurement) -> Command:
        """The controller's command; after a hold it makes up little by little for the way from there."""
        self.holds = False
        if isinstance(command.q_target, np.ndarray):  # another kind may be no target at all, which the guard refuses
            self._sent.append(command.q_target)
        if command.q_target is None or (self._frozen is None and self._behind is None):
            return command
        if self._frozen is not None:
            self._behind, self._frozen = self._frozen - command.q_target, None
            self._thawed_ns = measurement.t_ns
        left = 1.0 - (measurement.t_ns - self._thawed_ns) / THAW_NS
        if left <= 0.0 or self._behind is None:
            self._behind = None
            return command
        return replace(command, q_target=command.q_target + left * self._behind)
