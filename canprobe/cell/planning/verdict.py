"""The plan in five lines: whether it fits, nodes, load and slack, witnesses of the force, and what is left out."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Sequence

from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.witnesses import witness_rows

MIN_CHARACTERS = 40
"""Least length of a line: no line is broken before it."""
ALL_TABLES = "--full prints all tables"


def verdict_text(plan: Plan, width: int | None = None) -> str:
    """The verdict with all warnings, ending with a newline.

    Args:
        plan: the plan.
        width: characters after which a line is broken; None: lines stay whole.
    """
    room = None if width is None else max(width, MIN_CHARACTERS)
    parts = (part for line in (*verdict_lines(plan), ALL_TABLES) for part in broken(line, room, indent=13))
    return "\n".join(parts) + "\n"


def verdict_lines(plan: Plan) -> list[str]:
    """The verdict below the title of the scene."""
    title = f": {plan.setup.title}" if plan.setup.title else ""
    return [f"{plan.setup.name}{title}", *(f"  {subject:<11}{text}" for subject, text in _verdict(plan))]


def broken(line: str, width: int | None, *, indent: int) -> list[str]:
    """A line in parts of a width, the later ones indented."""
    if width is None or len(line) <= width:
        return [line]
    return textwrap.wrap(line, width, subsequent_indent=" " * indent)


def _verdict(plan: Plan) -> Iterator[tuple[str, str]]:
    bus = plan.setup.bus
    channels = " and ".join(one.channel for one in plan.buses)
    yield "fits", f"on {channels} ({bus.interface}), {bus.bitrate} bit/s, {plan.sync.rate_hz:g} Hz"
    yield "nodes", _nodes(plan)
    yield "load", _load(plan)
    if witnesses := witness_rows(plan):
        yield "witnesses", _witnesses(witnesses)
    yield "left out", f"{len(plan.left_out)}: {'; '.join(what for what, _ in plan.left_out)}"
    for choice in plan.choices:
        yield "chosen", f"{choice.key} = {choice.written}: {choice.why}"
    for what, why in plan.not_available:
        yield "lacks", f"{what}: {why}"
    for warning in plan.warnings:
        yield "warning", warning


def _nodes(plan: Plan) -> str:
    """The nodes by kind with their ids, and which of them are real."""
    drives, arrays = ([n.node_id for n in plan.nodes if n.kind == kind] for kind in ("drive", "tactile"))
    found = []
    if drives:
        found.append(f"{len(drives)} drive{'s' * (len(drives) > 1)} ({id_ranges(drives)})")
    if arrays:
        found.append(f"tactile array ({id_ranges(arrays)})")
    if plan.raw:
        found.append("array without a node id")
    real = [node.node_id for node in plan.nodes if not node.emulated]
    emulated = "all emulated" if not real else "none emulated" if len(real) == len(plan.nodes) else None
    return f"{', '.join(found) or 'none'}; {emulated or f'real: {id_ranges(real)}, the others emulated'}"


def _load(plan: Plan) -> str:
    """The worst-case load, and where the least time is left: in a cycle, and before the deadline of a frame."""
    several = len(plan.buses) > 1
    loads = " and ".join(f"{100 * b.traffic.load:.1f} %{f' on {b.channel}' * several}" for b in plan.buses)
    budget = plan.traffic.budget
    parts = [f"{loads} at worst"]
    if budget.slack_ns is not None:
        parts.append(f"{budget.slack_ns / 1000:g} of {budget.period_ns / 1000:g} µs are left in a cycle")
    bounded = [(pdo.slack_ns, pdo) for pdo in plan.pdos if pdo.slack_ns is not None]
    if bounded:
        slack_ns, pdo = min(bounded, key=lambda one: one[0])
        parts.append(f"the tightest frame, {pdo.cob_id:03X}h, is {slack_ns / 1000:g} µs before its deadline")
    return "; ".join(parts)


def _witnesses(rows: Sequence[tuple[str, str]]) -> str:
    """The witnesses that watch the force beside the array, and those that do not."""
    silent = [name for name, text in rows if text.startswith(("silent", "none"))]
    watching = ", ".join(name for name, _ in rows if name not in silent) or "none"
    return watching + (f"; silent: {', '.join(silent)}" if silent else "")


def id_ranges(ids: Iterable[int]) -> str:
    """Node ids as `1–6, 16`."""
    rows: list[list[int]] = []
    for one in sorted(ids):
        if rows and one == rows[-1][-1] + 1:
            rows[-1].append(one)
        else:
            rows.append([one])
    return ", ".join(str(row[0]) if len(row) == 1 else f"{row[0]}–{row[-1]}" for row in rows)
