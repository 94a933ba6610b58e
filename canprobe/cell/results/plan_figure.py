"""The picture of a plan: its cycles on every bus, and the response time of each message in its deadline."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.patches import Patch

from canprobe.cell.planning.model import Part, Plan
from canprobe.cell.planning.timeline import timeline
from canprobe.cell.planning.traffic import on_the_wire
from canprobe.cell.results.picture import AMBER, BLUE, FAINT, GREY, INK, ORANGE, SHADE, SKY, legend, picture

COLOURS: dict[Part, str] = {
    "SYNC": INK, "feedback": BLUE, "controller": GREY, "command": AMBER, "tactile": SKY, "other": FAINT,
}  # fmt: skip
NAMES: dict[Part, str] = {
    "SYNC": "SYNC", "feedback": "feedback (TPDO)", "controller": "controller", "command": "commands (RPDO)",
    "tactile": "tactile frame", "other": "TPDO that is not used",
}  # fmt: skip
_ROW_INCHES = 0.21


def draw_plan(plan: Plan, path: Path | str) -> None:
    """Draw the timeline and the response times.

    Args:
        plan: the plan.
        path: path of the picture; its suffix names the format.
    """
    messages = on_the_wire(plan.pdos)
    heights = [0.45 * (len(plan.buses) + 1) + 0.5, _ROW_INCHES * len(messages) + 0.6]
    loads = ", ".join(f"{bus.channel} {100 * bus.load:.0f} %" for bus in plan.buses)
    title = f"{plan.scene.name} at {plan.sync.rate_hz:g} Hz, {plan.scene.bus.bitrate / 1e6:g} Mbit/s"
    with picture(path, f"{title}: worst-case load {loads}", sum(heights) + 1.1) as figure:
        upper, lower = figure.subplots(2, 1, height_ratios=heights)
        _draw_cycles(upper, plan)
        _draw_responses(lower, plan)
        used = {slot.part for slot in timeline(plan)}
        legend(figure, [Patch(color=COLOURS[part], label=NAMES[part]) for part in COLOURS if part in used])


def _draw_cycles(axes: Axes, plan: Plan) -> None:
    rows = [*(bus.channel for bus in plan.buses), ""]
    slots, period_us = timeline(plan), plan.sync.period_ns / 1000
    for slot in slots:
        y, start, length = rows.index(slot.channel), slot.start_ns / 1000, (slot.end_ns - slot.start_ns) / 1000
        axes.barh(y, length, left=start, height=0.62, color=COLOURS[slot.part], edgecolor="white", linewidth=0.5)
    cycles = 1 + max(slot.cycle for slot in slots)
    for cycle in range(cycles + 1):
        axes.axvline(cycle * period_us, color=INK, linewidth=1.0)
    axes.set_yticks(range(len(rows)), [row or "controller" for row in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlim(-0.01 * cycles * period_us, 1.01 * cycles * period_us)
    axes.set(title="As it goes, every frame of its worst-case length; line: SYNC", xlabel="time after SYNC (µs)")
    _bare(axes)


def _draw_responses(axes: Axes, plan: Plan) -> None:
    messages = on_the_wire(plan.pdos)
    for y, pdo in enumerate(messages):
        part: Part = "tactile" if pdo.kind == "tactile" else "command" if pdo.direction == "rpdo" else "feedback"
        axes.barh(y, 100, height=0.72, color=SHADE)
        if pdo.response_ns is None:
            axes.text(1, y, "no bound", va="center", fontsize=8, color=ORANGE)
            continue
        share = 100 * pdo.response_ns / pdo.deadline_ns
        axes.barh(y, share, height=0.72, color=COLOURS[part] if share <= 100 else ORANGE)
        text = f"{pdo.response_ns / 1000:.0f} of {pdo.deadline_ns / 1000:.0f} µs"
        axes.text(101, y, text, va="center", fontsize=8)
    labels = [f"{pdo.cob_id:03X}h  node {pdo.node_id:2} {pdo.direction.upper()}{pdo.number}" for pdo in messages]
    axes.set_yticks(range(len(messages)), labels, fontsize=8, family="monospace")
    axes.set_ylim(len(messages) - 0.4, -0.6)
    axes.set_xlim(0, 115)
    axes.set_xticks(range(0, 101, 20))
    axes.set(
        title="At the latest, with everything else on the bus", xlabel="worst-case response time, % of the deadline"
    )
    _bare(axes)


def _bare(axes: Axes) -> None:
    axes.grid(visible=False)
    axes.spines["left"].set_visible(False)
