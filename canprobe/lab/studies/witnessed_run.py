"""A run of a session to its end, a witness that records the true force meanwhile, and what its record shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby

from canprobe.cell.master.conditions import BY_KEY
from canprobe.cell.master.controller import Controller, Measurement
from canprobe.cell.master.supervision import Limits
from canprobe.cell.plant.plant import Plant
from canprobe.cell.session.session import Session
from canprobe.errors import CanprobeError, SafetyStop
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.protocol.frames import Frame

RELEASE_NS = 100_000_000
"""Time that the retreat has, from its command, to bring the force below the limit."""
LONGEST_S = 20.0
"""Virtual time after which a run hangs: nominal runs take four seconds, every time-out in them less than ten."""


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
        force = self._plant.truth_row()["force"]
        assert isinstance(force, float)
        self.rows.append((t_ns, force))
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


def reaction_ns(key: str, limits: Limits) -> int:
    """Time to the reaction to a condition of the supervision, ns."""
    within = BY_KEY[key].within
    assert within is not None
    return within(limits)


def longest_above(rows: Sequence[tuple[int, float]], limit: float) -> int:
    """Longest time without a break for which the force of (t_ns, force) rows is above the limit, ns."""
    stretches = [list(some) for within, some in groupby(rows, lambda row: row[1] <= limit) if not within]
    return max((some[-1][0] - some[0][0] for some in stretches), default=0)


def forces_of(session: Session) -> list[tuple[float, float]]:
    """Force of the plant of a finished session: (time, s; force, N)."""
    truth = session.buses.truth
    return list(zip(truth["t_s"].tolist(), truth["force_n"].tolist(), strict=True)) if "force_n" in truth else []
