"""What a rule is, and what it finds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar

from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.bus_state import BusState
from canprobe.fieldbus.tools.judge.events import BusEvent

QUEUED_NS = 5_000_000
"""Time for which a frame may have waited in its sender's queue."""
CHARGED_NS = 1_000_000_000
"""Time after a fault of ours for which what follows is charged to it."""
_KEPT_FINDINGS = 5


class Severity(StrEnum):
    """What a fault of a master costs."""

    UNSAFE = "unsafe"
    WRONG = "wrong"
    REFUSED = "refused"
    MINOR = "minor"


@dataclass(frozen=True, slots=True)
class RuleFinding:
    """One thing that a master did wrong.

    Attributes:
        t_ns: time.
        node_id: node; None where it is none.
        what: what was wrong, a sentence with its numbers.
        frames: frames that show it, in order.
    """

    t_ns: int
    node_id: int | None
    what: str
    frames: tuple[BusFrame, ...]


@dataclass(slots=True)
class Charges:
    """Times in which what happens is charged to a fault that was thrown, not to the master.

    Attributes:
        spans_ns: begin and end of each.
    """

    spans_ns: list[tuple[int, int]] = field(default_factory=list)

    def cover(self, t_ns: int) -> bool:
        """Whether a time is charged to a fault."""
        return any(begin <= t_ns <= end + CHARGED_NS for begin, end in self.spans_ns)


class Rule:
    """One rule. Subclasses set the class attributes and override `see`, `begin` for what
    they remember, and `end` where the end of the bus matters.

    Attributes:
        number: number of the fault, stable.
        name: a few words, stable.
        group: family.
        severity: what the fault costs.
        source: where the fault was seen, or the clause.
        expected: what a good master does.
        hint: what to change.
        hears: events that `see` gets.
        answers: whether it judges the reaction to a fault, so that faults of ours do not excuse it.
        looked: number of times that there was something to judge.
        findings: first findings; `count` has the number of all.
    """

    number: ClassVar[int]
    name: ClassVar[str]
    group: ClassVar[str]
    severity: ClassVar[Severity]
    source: ClassVar[str] = "CiA 301, CiA 402-2"
    expected: ClassVar[str]
    hint: ClassVar[str]
    hears: ClassVar[tuple[type[BusEvent], ...]] = ()
    answers: ClassVar[bool] = False

    def __init__(self, bus: BusState, charges: Charges) -> None:
        self.bus = bus
        self.looked = 0
        self.count = 0
        self.findings: list[RuleFinding] = []
        self._charges = charges
        self._runs: Counter[Hashable] = Counter()
        self.begin()

    def begin(self) -> None:
        """Set up what the rule remembers."""

    def see(self, event: BusEvent) -> None:
        """Take an event; the state of the bus has it already."""

    def end(self) -> None:
        """Take the end of the bus."""

    def blame(self, what: str, *frames: BusFrame | None, node_id: int | None = None) -> None:
        """Note a finding at the present time."""
        t_ns = self.bus.now_ns
        if not self.answers and self._charges.cover(t_ns):
            return
        self.count += 1
        if len(self.findings) < _KEPT_FINDINGS:
            shown = sorted(dict.fromkeys(frame for frame in frames if frame is not None), key=lambda frame: frame.t_ns)
            self.findings.append(RuleFinding(t_ns, node_id, what, tuple(shown)))

    def in_a_row(self, key: Hashable, bad: bool, wanted: int = 2) -> bool:
        """Count what is bad in a row; whether it has just become `wanted`. While a fault excuses it nothing counts."""
        self.looked += 1
        excused = bad and not self.answers and self._charges.cover(self.bus.now_ns)
        self._runs[key] = self._runs[key] + 1 if bad and not excused else 0
        return self._runs[key] == wanted
