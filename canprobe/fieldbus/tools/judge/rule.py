"""What a rule is, and what it finds."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Callable, Generator, Hashable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import NoneType
from typing import Any, TypeVar, get_args, get_type_hints

from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.bus_state import BusState
from canprobe.fieldbus.tools.judge.events import BusEvent
from canprobe.fieldbus.tools.judge.seen_motor import SeenMotor
from canprobe.fieldbus.tools.judge.seen_node import Known, SeenNode
from canprobe.fieldbus.tools.reports.report import Severity

QUEUED_NS = 5_000_000
"""Time for which a frame may have waited in its sender's queue."""
SECOND_NS = 1_000_000_000
CHARGED_NS = SECOND_NS
"""Time after a fault of ours for which what follows is charged to it."""
_KEPT_FINDINGS = 5
_FACTS = tomllib.loads(Path(__file__).with_name("rules.toml").read_text(encoding="utf-8"))
Event = TypeVar("Event", bound=BusEvent)
Device = SeenNode | SeenMotor
Watch = Generator[None, Event | None, None]
"""Gets the events that its annotation names, one after the other, and None at the end of the bus."""


@dataclass(frozen=True, slots=True)
class RuleFinding:
    """One thing that a master did wrong.

    Attributes:
        t_ns: time.
        device: name of the node or motor; None where it is none.
        what: what was wrong, a sentence with its numbers.
        frames: frames that show it, in order.
    """

    t_ns: int
    device: str | None
    what: str
    frames: tuple[BusFrame, ...]


@dataclass(frozen=True, slots=True)
class Rule:
    """One rule: its facts, which `rules.toml` has, and the generator that judges by it.

    Attributes:
        number: number of the fault, stable.
        watch: function that makes the generator of a `Case`: for each node, where it takes one, else for the bus.
        answers: whether it judges the reaction to a fault, so that faults of ours do not excuse it.
        name: a few words, stable.
        group: family.
        severity: what the fault costs.
        source: where the fault was seen, or the clause.
        expected: what a good master does.
        hint: what to change.
    """

    number: int
    watch: Callable[..., Watch[Any]]
    answers: bool
    name: str
    group: str
    severity: Severity
    source: str
    expected: str
    hint: str

    def hears(self) -> tuple[type[BusEvent], ...]:
        """Kinds of the events that `watch` gets, which its annotation names."""
        _, sent, _ = get_args(get_type_hints(self.watch)["return"])
        return tuple(kind for kind in get_args(sent) if kind is not NoneType)


def rule(number: int, *, answers: bool = False) -> Callable[[Callable[..., Watch[Any]]], Rule]:
    """Make a `Rule` of the function below: a generator that gets events, each when the state of the bus has it.

    What the rule remembers are the variables of the generator.
    """
    facts = _FACTS[str(number)]
    return lambda watch: Rule(number, watch, answers, **facts | {"severity": Severity(facts["severity"])})


class Case:
    """One rule at work on one bus.

    Args:
        rule: the rule.
        bus: state of the bus.
        charges_ns: begin and end of each fault of ours; what happens meanwhile is charged to it, not to the master.

    Attributes:
        looked: number of times that there was something to judge.
        findings: first findings; `count` has the number of all.
        intervals_ns: times that the rule has measured.
    """

    def __init__(self, rule: Rule, bus: BusState, charges_ns: Sequence[tuple[int, int]]) -> None:
        self.rule, self.bus = rule, bus
        self.looked = self.count = 0
        self.findings: list[RuleFinding] = []
        self.intervals_ns: list[int] = []
        self._charges_ns = charges_ns
        self._runs: Counter[Hashable] = Counter()

    def watches(self) -> Iterable[tuple[Device | None, Watch[Any]]]:
        """Each node or motor with the generator that follows it; None with the one that follows the bus."""
        watch = self.rule.watch
        if "motor" in watch.__annotations__:
            return [(motor, watch(self, motor)) for motor in self.bus.motors]
        if "node" not in watch.__annotations__:
            return [(None, watch(self))]
        return [(node, watch(self, node)) for node in self.bus.nodes.values()]

    def blame(self, device: Device | None, what: str, *shown: BusFrame | BusEvent | Known | None) -> None:
        """Note a finding at the present time, with the frames that show it."""
        if self._is_excused():
            return
        self.count += 1
        if len(self.findings) < _KEPT_FINDINGS:
            frames = dict.fromkeys(one if isinstance(one, BusFrame) else one.frame for one in shown if one is not None)
            ordered = tuple(sorted(frames, key=lambda frame: frame.t_ns))
            name = device.name if device is not None else None
            self.findings.append(RuleFinding(self.bus.now_ns, name, what, ordered))

    def expect(self, device: Device | None, good: bool, what: str, *shown: BusFrame | BusEvent | Known | None) -> None:
        """Judge once: note a finding, as `blame` does, unless all is well."""
        self.looked += 1
        if not good:
            self.blame(device, what, *shown)

    def in_a_row(self, key: Hashable, bad: bool, wanted: int = 2) -> bool:
        """Count what is bad in a row; whether it has just become `wanted`. While a fault excuses it nothing counts."""
        self.looked += 1
        self._runs[key] = self._runs[key] + 1 if bad and not self._is_excused() else 0
        return self._runs[key] == wanted

    def _is_excused(self) -> bool:
        spans = () if self.rule.answers else self._charges_ns
        return any(begin <= self.bus.now_ns <= end + CHARGED_NS for begin, end in spans)
