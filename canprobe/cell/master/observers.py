"""Observers of a cell: they see every cycle after its work is done, and a failure of theirs does not stop it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.cycle import TIMED_CYCLES
from canprobe.fieldbus.bus.clock import elapsed_ns
from canprobe.fieldbus.bus.port import TimedFrame

MAX_FRAMES = 100_000
"""Frames that are kept for the next observation: bring-up has a few thousand and no cycle."""
COSTS_KEPT = 20_000
"""Costs that are kept, of the last four minutes at 400 Hz: a cell may stay up for days."""


@dataclass(frozen=True, slots=True)
class Observation:
    """A cycle as an observer sees it, once its commands are on the bus.

    Attributes:
        t_ns: deadline of its SYNC on the run's clock, ns, as in `bus.log`. A time of the cycle's own, such as
            `measurement.t_ns` or a tactile sample's, is on this clock with `t_ns - measurement.t_ns` added.
        measurement: measurement of the controller; None with frames alone, at bring-up and after the last cycle.
        command: command of the controller; None while the drives are enabled or stopped.
        frames: frames on the bus since the last observation, (can_id, data, t_ns).
    """

    t_ns: int
    measurement: Measurement | None
    command: Command | None
    frames: list[TimedFrame]


class Observer(Protocol):
    """An object with ``observe(observation)``; a plain function is accepted as well."""

    def observe(self, observation: Observation) -> None:
        """Take one observation, quickly: the next SYNC is waiting."""


AnyObserver = Observer | Callable[[Observation], None]


class Observers:
    """Calls every observer after each cycle. One that raises is not called again; the cell goes on.

    Args:
        observers: observers to call.

    Attributes:
        origin_ns: zero of the run's clock, on the clock of the frames.
        cost_ns: time that all observers took together, every ``TIMED_CYCLES`` cycles.
        faults: observers that failed, a line each.
    """

    def __init__(self, observers: Iterable[AnyObserver]) -> None:
        self.origin_ns = 0
        self.cost_ns: deque[int] = deque(maxlen=COSTS_KEPT)
        self.faults: list[str] = []
        self._calls = [one.observe if hasattr(one, "observe") else one for one in observers]
        self._frames: list[TimedFrame] = []

    def tap(self, write: Callable[[int, bytes, int], None]) -> Callable[[int, bytes, int], None]:
        """A recorder of frames that passes them on to ``write``."""

        def both(can_id: int, data: bytes, t_ns: int) -> None:
            write(can_id, data, t_ns)
            frames = self._frames
            if len(frames) < MAX_FRAMES:
                frames.append((can_id, data, t_ns - self.origin_ns))

        return both

    def cycle(self, start_ns: int, measurement: Measurement, command: Command | None) -> None:
        """Call the observers after a cycle.

        Args:
            start_ns: deadline of the first SYNC, on the run's clock.
            measurement: measurement of the cycle.
            command: command of the cycle; None without a controller.
        """
        timed = measurement.cycle % TIMED_CYCLES == 0
        started_ns = elapsed_ns() if timed else 0
        frames, self._frames = self._frames, []
        self._call(Observation(start_ns + measurement.t_ns, measurement, command, frames))
        if timed:
            self.cost_ns.append(elapsed_ns() - started_ns)

    def frames_alone(self, t_ns: int) -> None:
        """Hand over the frames of a time without cycles, at ``t_ns`` on the clock of the frames."""
        frames, self._frames = self._frames, []
        if frames:
            self._call(Observation(t_ns - self.origin_ns, None, None, frames))

    def _call(self, observation: Observation) -> None:
        for call in tuple(self._calls):
            try:
                call(observation)
            except Exception as error:  # whoever only watches must not stop the cell; the fault is in the summary
                self._calls.remove(call)
                name = getattr(call, "__qualname__", type(call).__name__)
                self.faults.append(f"observer {name} failed and is not called any more: {error!r}")
