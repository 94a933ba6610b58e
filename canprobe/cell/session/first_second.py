"""The first second of a run in real time, judged as a link by the figures of its own cycle."""

from __future__ import annotations

from canprobe.cell.master.cell import Cell
from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.options import Say
from canprobe.cell.planning.model import Plan
from canprobe.fieldbus.tools.link import AnswerFigures, Fitness, LinkFigures, LinkLimits, judge_link


def link_limits(plan: Plan) -> LinkLimits:
    """Limits of a plan's cell for the link."""
    missed = plan.setup.arm.missed_syncs if plan.setup.arm is not None else 5
    return LinkLimits(missed, plan.setup.limits.late_share)


class FirstSecond:
    """Judges the first second of a run in real time by the figures of the cycle itself, and says where it is not fit.

    Args:
        cell: the cell, brought up.
        plan: its plan.
        say: called with the verdict, if it is not fit.
    """

    def __init__(self, cell: Cell, plan: Plan, say: Say) -> None:
        self._cell, self._plan, self._say = cell, plan, say
        patient = plan.setup.limits.late_share >= 1.0  # late cycles are expected, and stop nothing
        self._left: int | None = None if patient else round(1e9 / plan.sync.period_ns)
        self._begin = self._counts()

    def __call__(self, _: Measurement) -> None:
        """Count a cycle."""
        if self._left is None:
            return
        self._left -= 1
        if self._left > 0:
            return
        self._left = None
        cell, period_ns = self._cell, self._plan.sync.period_ns
        assert cell.cycle is not None
        missed, late, full = (now - then for now, then in zip(self._counts(), self._begin, strict=True))
        lateness = sorted(list(cell.cycle.statistics.period_error_ns)[-round(1e9 / period_ns) :])
        answers: tuple[AnswerFigures, ...] = ()
        if cell.drives is not None:
            number = len(lateness) * len(cell.drives.axes)
            answers = (AnswerFigures(0, number, (), min(late, missed), max(0, missed - late), (1,) * missed),)
        wait_ns = self._plan.traffic.budget.looks_ns[-1]
        figures = LinkFigures(period_ns, lateness, wait_ns, answers, queue_full=full)
        verdict = judge_link(figures, link_limits(self._plan))
        if verdict.fitness is not Fitness.FIT:
            self._say(
                f"warning: in its first second the link was {verdict.fitness} for {verdict.rate_hz:g} Hz: {late}"
                f" answers late, {missed} missed, {100 * figures.late_share():.1f} % overruns; canprobe check"
                f" {self._plan.setup.name} says why"
            )

    def _counts(self) -> tuple[int, int, int]:
        drives = self._cell.drives
        missed, late = (drives.missed, drives.late) if drives is not None else (0, 0)
        return missed, late, self._cell.port.counters.transmit_full
