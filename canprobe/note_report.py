"""What goes wrong in a cell that runs for days, told when it first happens and once more, counted, at the end."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from canprobe.cell.measurement import Measurement
from canprobe.session import Say, Session


@contextlib.contextmanager
def telling_notes(session: Session, say: Say) -> Iterator[Session]:
    """Open the session; when it is over, tell what went wrong in it and was lived with."""
    try:
        with session:
            yield session
    finally:
        for line in session.cell.faults if session.started else ():
            say(f"noted: {line}")


def news_teller(session: Session, say: Say) -> Callable[[Measurement], None]:
    """A function to be called after each cycle, which tells each kind of note once."""
    notes, told = session.cell.notes, 0

    def tell(_: Measurement) -> None:
        nonlocal told
        if len(notes) > told:
            for line in notes.lines()[told:]:
                say(f"noted: {line}")
            told = len(notes)

    return tell
