"""An arm that is not on the bus: poses of its flange in, poses of its flange out."""

from __future__ import annotations

from typing import Protocol

from canprobe.mechanics.types import Floats


class ExternalArm(Protocol):
    """An arm behind an interface of its own, for a cell with `arm.kind = "external"`.

    The cell calls the methods from one thread: `read` once at the beginning of each cycle, then `command` once in it.
    None of them may wait longer than a small part of a cycle. What they raise ends the run, and `stop` is called.
    """

    def read(self) -> tuple[Floats, int]:
        """The newest pose of the flange.

        Returns:
            T_base_flange (4, 4), float64, m, in the base frame of the arm; and the time at which the flange was there,
            ns on the clock of the arm, whose zero may be anywhere. The cell finds its offset from the clock of the bus.
        """
        ...

    def command(self, T_base_flange: Floats) -> None:
        """Send the flange to a pose (4, 4), m, in the base frame of the arm, within a cycle or as soon as it can.

        The arm takes each pose in the place of the one before. It stops by itself where none comes for
        `arm.stop_after_ms`. The first pose after `stop` is where the arm stands.
        """
        ...

    def stop(self) -> None:
        """Stop the arm at once and let it hold its place; called on every way out, more than once."""
        ...
