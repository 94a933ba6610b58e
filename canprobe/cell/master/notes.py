"""Faults in a run that did not stop it: one line a kind, however often it happened."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from itertools import count, groupby

from canprobe.errors import CanprobeError, NodeError

KINDS_KEPT = 100
"""Kinds that are distinguished; a node that sends another EMCY each time must not fill the memory."""
OTHER_KINDS_TEXT = "more of other kinds"


@dataclass(slots=True)
class _NoteKind:
    """An event that happens again and again."""

    what: str
    nodes: set[int] = field(default_factory=set)
    times: int = 0
    first_s: float | None = None
    last_s: float | None = None

    def __str__(self) -> str:
        who = f"{nodes_text(self.nodes)}: " if self.nodes else ""
        how_often = f", {self.times} times" if self.times > 1 else ""
        when = ""
        if self.first_s is not None and self.last_s is not None:
            first, last = f"at {self.first_s:.2f} s", f", last at {self.last_s:.2f} s"
            when = f", {first}" if self.times == 1 else f", first {first}{last}"
        return f"{who}{self.what}{how_often}{when}"


class Notes:
    """Counts faults by kind, in the order of the first of each. ``bus.log`` has them frame by frame."""

    def __init__(self) -> None:
        self._kinds: dict[str, _NoteKind] = {}

    def __len__(self) -> int:
        """Number of kinds."""
        return len(self._kinds)

    def attempt(self, action: Callable[[], None]) -> None:
        """Run one step of the way out to its end: an interrupt repeats it once, a failure is noted."""
        for _ in range(2):
            try:
                action()
            except KeyboardInterrupt:
                continue
            except CanprobeError as error:
                self.add(f"while stopping: {error}")
            return

    def add(self, what: str, *, node_id: int | None = None, t_s: float | None = None) -> None:
        """Count an event.

        Args:
            what: names the kind; nothing in it may change from one time to the next.
            node_id: the node that it happened to.
            t_s: time on the run's clock.
        """
        if what not in self._kinds and len(self._kinds) >= KINDS_KEPT:
            what = OTHER_KINDS_TEXT
        kind = self._kinds.setdefault(what, _NoteKind(what))
        kind.times += 1
        if node_id is not None:
            kind.nodes.add(node_id)
        if t_s is not None:
            kind.first_s = t_s if kind.first_s is None else kind.first_s
            kind.last_s = t_s

    def add_error(self, error: CanprobeError, then: str, t_s: float) -> None:
        """Count an error, with the reaction of the cell to it in ``then``."""
        reason, node_id = (error.reason, error.node_id) if isinstance(error, NodeError) else (str(error), None)
        self.add(f"{reason}: {then}", node_id=node_id, t_s=t_s)

    def saying(self, say: Callable[[str], None]) -> Callable[[str], None]:
        """A function that reports a step by ``say``; where that fails, it is noted: it must not stop the drives."""

        def report(text: str) -> None:
            try:
                say(text)
            except Exception as error:
                self.add(f"steps could not be reported: {type(error).__name__}")

        return report

    def lines(self) -> list[str]:
        """A line for each kind."""
        return [str(kind) for kind in self._kinds.values()]


def nodes_text(node_ids: Iterable[int]) -> str:
    """A list of nodes in words, neighbours joined: ``nodes 1-6, 16``."""
    ids = sorted(node_ids)
    steps = count()
    runs = [list(run) for _, run in groupby(ids, key=lambda node_id: node_id - next(steps))]
    parts = [part for run in runs for part in ([f"{run[0]}-{run[-1]}"] if len(run) > 2 else map(str, run))]
    return f"node{'s' * (len(ids) > 1)} {', '.join(parts)}"
