"""The table of conditions as docs/supervision.md has it."""

from __future__ import annotations

from canprobe.cell.conditions import CONDITIONS
from canprobe.cell.supervision import Condition, Limits

HEADINGS = ("what", "how it is seen", "at the latest after", "what the cell does", "afterwards")
USUAL = Limits(period_ns=2_500_000)
"""400 Hz, tactile frames at 200 Hz, and the other values that a scene has by default."""


def markdown_table(limits: Limits = USUAL) -> str:
    """The table in Markdown, its times for ``limits``."""
    rows = [HEADINGS, ("---",) * len(HEADINGS), *(_row(condition, limits) for condition in CONDITIONS)]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _row(condition: Condition, limits: Limits) -> tuple[str, ...]:
    does = condition.reaction.value + (f": {condition.does}" if condition.does else "")
    within = f"{condition.within(limits) / 1e6:g} ms" if condition.within is not None else "–"
    return condition.what, condition.seen, within, does, condition.back
