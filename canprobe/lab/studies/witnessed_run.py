"""A run of a session to its end, and a witness that records the true force meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from canprobe.cell.master.controller import Controller, Measurement
from canprobe.cell.plant.plant import Plant
from canprobe.cell.session.session import Session
from canprobe.errors import CanprobeError, SafetyStop
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.lab.studies.fault_scores import LONGEST_S


class HangError(Exception):
    """The run did not end."""


class Witness(Participant):
    """A participant of the bus that looks at the plant periodically, even when the master has stopped sending SYNC.

    Args:
        plant: plant of the run.
        period_ns: time between two looks.

    Attributes:
        rows: (t_ns, force in N) of each look.
    """

    listens = frozenset[int]()
    next_deadline_ns: int | None = None

    def __init__(self, plant: Plant, period_ns: int) -> None:
        self.rows: list[tuple[int, float]] = []
        self.next_deadline_ns = period_ns
        self._plant, self._period_ns = plant, period_ns

    def advance(self, t_ns: int) -> Sequence[Frame]:
        """Look at the plant where it is time."""
        self.next_deadline_ns = t_ns + self._period_ns
        self._plant.advance(t_ns)
        self.rows.append((t_ns, float(self._plant.truth()["force"])))
        if t_ns > LONGEST_S * 1e9:
            raise HangError(f"no end after {LONGEST_S:g} s")
        return ()


def run_to_end(
    session: Session, task: Controller, progress: Callable[[Measurement], None] = lambda _: None
) -> tuple[str, Exception | None]:
    """Bring the cell up and run its task; the outcome in words, and the exception that ended the run."""
    try:
        with session:
            session.run(task, progress=progress)
    except SafetyStop as stop:
        return "stopped for safety", stop
    except CanprobeError as error:
        return ("bus or node failure" if session.opened else "bring-up refused"), error
    except HangError as hang:
        return "hang", hang
    except Exception as error:  # of any kind: it is a failure of ours, and the study continues
        return "crash", error
    return "completed", None
