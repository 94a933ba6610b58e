"""`canprobe up`: a cell that holds its position for days under supervision."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence

from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.options import RunOptions, Say, quiet
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.children import Bridges
from canprobe.cell.session.joint_record import warned
from canprobe.cell.session.session import Session, with_bridges
from canprobe.cell.session.target import need_real_bus
from canprobe.cell.tasks.from_plan import make_task

ROWS_OF_UP = 4000
"""Number of cycles whose rows are kept: `up` runs for days."""
EARLY_CYCLES = 25
"""Cycles after a return in which nobody lets motion go on: a key that is read then was pressed before it."""


def up(
    scene: Scene,
    *,
    bridge: Sequence[str] = (),
    say: Say = quiet,
    recover: bool = False,
    asked: Callable[[], bool] = lambda: False,
) -> None:
    """Bring the cell up, hold and supervise it until it is interrupted, then stop it safely.

    Args:
        scene: a scene on a bus that other processes can reach.
        bridge: names of bridges to other tools, besides those of the scene.
        say: called with each step, with each new kind of fault, and at the end with the number of each.
        recover: come back after a node or the bus was lost; see `canprobe.cell.session.recovery`.
        asked: called in each cycle; after a loss, True lets motion go on, but not in the first `EARLY_CYCLES`.

    Raises:
        UsageError: when the scene does not fit or is on a lockstep bus.
        BusError, SafetyStop: as in :func:`canprobe.run`.
    """
    need_real_bus(scene, "up")
    plan = warned(make_plan(resolve(with_bridges(scene, bridge))))
    with Bridges(plan, None, virtual=False, say=say) as bridges:
        session = Session(plan, RunOptions(None, say, bridges.observers, ROWS_OF_UP, recover=recover))
        with reporting_notes(session, say) as report_news:
            resume = "; after a loss, r and Enter let motion go on" if recover else ""
            say(f"the cell is up: nodes {', '.join(map(str, plan.node_ids))}; Ctrl-C stops it{resume}")

            cell, age = session.cell, EARLY_CYCLES

            def after_cycle(measurement: Measurement) -> None:
                nonlocal cell, age
                report_news(measurement)
                age = age + 1 if session.cell is cell else 0
                cell = session.cell
                if asked() and age >= EARLY_CYCLES:
                    session.resume()

            task = bridges.open_to_requests(None, lambda: make_task(plan))
            session.run(task, after_cycle if recover else report_news)


@contextlib.contextmanager
def reporting_notes(session: Session, say: Say) -> Iterator[Callable[[Measurement], None]]:
    """Open the session, and at its end report the faults that did not stop it, each kind with its number.

    Yields:
        A function to call after each cycle; it reports each new kind of fault.
    """
    said = 0

    def report_news(_: Measurement) -> None:
        nonlocal said
        notes = session.cell.notes
        if len(notes) > said:
            for line in notes.lines()[said:]:
                say(f"noted: {line}")
            said = len(notes)

    try:
        with session:
            yield report_news
    finally:
        for line in session.cell.notes.lines() if session.started else ():
            say(f"noted: {line}")
