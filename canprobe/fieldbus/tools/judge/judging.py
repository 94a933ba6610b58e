"""Frames in, a report out: all rules, on one bus; and what of the list of faults is no rule."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.tools.judge import enable, motor_rules, network_rules, pdo_rules, reactions, sdo_rules, targets
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.bus_state import BusState
from canprobe.fieldbus.tools.judge.events import BusEvent
from canprobe.fieldbus.tools.judge.rule import Case, Rule, Watch
from canprobe.fieldbus.tools.judge.seen_motor import SeenMotor
from canprobe.fieldbus.tools.reports import Report, ReportRow, Verdict

_MODULES = (enable, targets, pdo_rules, network_rules, sdo_rules, reactions, motor_rules)
_FOUND = (one for module in _MODULES for one in vars(module).values() if isinstance(one, Rule))
RULES = tuple(sorted(_FOUND, key=attrgetter("number")))
"""All rules, in the order of their numbers."""
NO_RULES: tuple[tuple[str, str], ...] = (
    ("12 enabling as part of initialisation", "the bus does not show whether a person asked for it"),
)
"""Known faults of masters that are not judged, and why."""
_Key = tuple[type[BusEvent], object]
"""Kind of an event, and the node or motor that it is about; None for rules on the whole bus."""


class Judge:
    """Judges the master on one bus.

    Args:
        nodes: description of each node by its id.
        served: whether the nodes are emulated ones that are served here.
        bitrate: bit rate, bit/s.
        charges_ns: begin and end of each fault that was thrown at the nodes.
        without: numbers of rules that are left out.
        motors: motors that do not speak CANopen; without any, no rule on them is there.

    Attributes:
        bus: state of the bus.
        cases: each rule at work, by its number.
        frame_count: number of frames taken.
    """

    def __init__(
        self,
        nodes: Mapping[int, Description],
        *,
        served: bool = False,
        bitrate: int = 1_000_000,
        charges_ns: Sequence[tuple[int, int]] = (),
        without: Collection[int] = (),
        motors: Sequence[SeenMotor] = (),
    ) -> None:
        self.bus = BusState(nodes, served=served, bitrate=bitrate, motors=motors)
        self._rules = [rule for rule in RULES if (motors if rule.group == "motor" else nodes or not motors)]
        cases = (Case(rule, self.bus, charges_ns) for rule in self._rules if rule.number not in without)
        self.cases = {case.rule.number: case for case in cases}
        self.frame_count = 0
        self._watches: list[Watch[Any]] = []
        self._ears: dict[_Key, list[Watch[Any]]] = {}
        for case in self.cases.values():
            for node, watch in case.watches():
                next(watch)
                self._watches.append(watch)
                for kind in case.rule.hears():
                    self._ears.setdefault((kind, node), []).append(watch)

    def hear(self, frames: Iterable[BusFrame], end_ns: int = 0) -> Judge:
        """Take the frames of the bus, from the first to the last; return the judge.

        Args:
            frames: the frames, in the order of their times.
            end_ns: time up to which the bus was heard, where that is later than its last frame.
        """
        for frame in frames:
            self.frame_count += 1
            for event in self.bus.take(frame):
                for node in (None, *event.among(self.bus.nodes.values())):
                    for watch in self._ears.get((type(event), node), ()):
                        watch.send(event)
        self.bus.now_ns = max(self.bus.now_ns, end_ns)
        for watch in self._watches:
            with contextlib.suppress(StopIteration):
                watch.send(None)
        return self

    def report(self, title: str, facts: Mapping[str, str], log: str | None = None) -> Report:
        """The report on what was heard.

        Args:
            title: what was judged.
            facts: facts on bench and command.
            log: path of the recorded frames; None where they were not kept.
        """
        report = Report("judge", title, dict(facts), [_row(case) for case in self.cases.values()], log=log)
        without = [rule for rule in self._rules if rule.number not in self.cases]
        report.left_out += NO_RULES if self.bus.nodes else ()
        report.left_out += [(f"{rule.number:02} {rule.name}", "left out on request") for rule in without]
        for case in self.cases.values():
            if case.intervals_ns:
                report.distributions["SYNC interval"] = tuple(ns * 1e-6 for ns in case.intervals_ns)
        return report


def _row(case: Case) -> ReportRow:
    """A row of the report for one rule."""
    rule = case.rule
    row = ReportRow(rule.group, f"{rule.number:02} {rule.name}", Verdict.PASS, rule.source, rule.expected)
    if not case.looked and not case.count:
        return replace(row, verdict=Verdict.NOT_APPLICABLE, detail="the bus gave nothing to judge it by")
    if not case.count:
        return row
    first = case.findings[0]
    device = f"{first.device}: " if first.device is not None else ""
    more = f" ({case.count} times)" if case.count > 1 else ""
    return replace(
        row,
        verdict=Verdict.FAIL,
        came=tuple(str(frame) for finding in case.findings for frame in finding.frames),
        detail=f"{device}{first.what} at {first.t_ns * 1e-9:.6f} s{more}",
        hint=rule.hint,
        severity=rule.severity.value,
    )
