"""Who looks at the plant of a fault campaign's run, and who stands in for those that are not needed in it."""

from __future__ import annotations

from collections.abc import Sequence

from canprobe.emulator.plant.world import Plant
from canprobe.protocol.frames import Frame

LONGEST_S = 15.0
"""Virtual time after which a run hangs: nominal runs take two seconds, every time-out in them less than ten."""


class HangError(Exception):
    """The run did not come to its end."""


class Silent:
    """In the place of a participant that is not needed."""

    name = "silent"
    next_deadline_ns: int | None = None
    listens: frozenset[int] = frozenset()

    def start(self, t_ns: int) -> Sequence[Frame]:
        """Nothing to say."""
        return ()

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        """Nothing to hear."""
        return ()

    def advance(self, t_ns: int) -> Sequence[Frame]:
        """Nothing to do."""
        return ()


class Witness(Silent):
    """Looks at the plant every so often, also where the master sends no SYNC any more.

    Args:
        plant: of the run.
        period_ns: between two looks.

    Attributes:
        rows: (t_ns, force in N) of each look.
    """

    name = "witness"

    def __init__(self, plant: Plant, period_ns: int) -> None:
        self.rows: list[tuple[int, float]] = []
        self.next_deadline_ns = period_ns
        self._plant, self._period_ns = plant, period_ns

    def advance(self, t_ns: int) -> Sequence[Frame]:
        """Look."""
        self.next_deadline_ns = t_ns + self._period_ns
        self._plant.advance(t_ns)
        self.rows.append((t_ns, float(self._plant.truth()["force"])))
        if t_ns > LONGEST_S * 1e9:
            raise HangError(f"not at its end after {LONGEST_S:g} s")
        return ()
