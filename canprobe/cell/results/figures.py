"""The figure of a run: contact trajectory as in the paper, force, curvature with its band, taxel image."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure, SubFigure

from canprobe.cell.results.picture import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    SKY,
    box,
    drawn_rows,
    legend,
    log_scale,
    parts,
    picture,
    sheet,
)
from canprobe.cell.results.run_data import RunData
from canprobe.cell.results.scores import TWO_SIGMA
from canprobe.cell.results.surface_figure import MapPlane, add_sheet, map_surface, true_surface
from canprobe.cell.rows import joint_positions
from canprobe.cell.tasks.sensing import curvature_sigma
from canprobe.cell.tasks.task import Phase
from canprobe.errors import UsageError
from canprobe.mechanics.touch.image.calibration import NO_FORCE_REFERENCE

Panel = Callable[[SubFigure, RunData], None]
MIN_SPAN_PER_M = 1.0
"""Least height of the panel of curvatures, 1/m, so that noise on a plane looks small."""


def draw_run(result: RunData, path: Path) -> None:
    """Draw the panels for which the run has data, and write a PNG."""
    if rows := _rows(result):
        with picture(path, _title(result), 0.8 + 2.9 * len(rows)) as figure:
            _fill(figure, rows, result)


def run_figure(result: RunData) -> Figure:
    """The figure of a run, not written.

    Raises:
        UsageError: when the run has nothing to draw.
    """
    if not (rows := _rows(result)):
        raise UsageError("plot: this run has no data for any panel")
    with sheet(_title(result), 0.8 + 2.9 * len(rows)) as figure:
        _fill(figure, rows, result)
    return figure


def _fill(figure: Figure, rows: list[list[tuple[Panel, float]]], result: RunData) -> None:
    for strip, row in zip(parts(figure, len(rows), 1), rows, strict=True):
        places = parts(strip, 1, len(row), width_ratios=[width for _, width in row])
        for part, (draw, _) in zip(places, row, strict=True):
            draw(part, result)


def _rows(result: RunData) -> list[list[tuple[Panel, float]]]:
    """Rows of panels, each with its share of the width."""
    rows: list[list[tuple[Panel, float]]]
    log, scanning = result.log, any(result.estimates.values())
    force = [(_draw_force, 3.0)] if "force_n" in log else []
    taxels = [(_draw_taxels, 2.0)] if result.taxels is not None else []
    if scanning:
        path = [(_draw_trajectory, 3.0)] if "contact_mm" in log else []
        rows = [[*path, *force], [(_draw_curvature, 3.0), *taxels]]
        if "explored_mm" in log:
            rows.append([(_draw_exploration, 1.0)])
    else:
        rows = [[*force, *taxels]]
        if result.summary.get("calibration") is not None:
            rows.append([(_draw_tool, 1.0)])
        elif joint_positions(log) is not None:  # a failed bring-up may leave no data
            rows.append([(_draw_joints, 1.0)])
    return [row for row in rows if row]


def _title(result: RunData) -> str:
    summary = result.summary
    truth = "black and grey: true, of the emulated plant, unknown to the cell" if result.truth else "no truth is known"
    newtons = f" · {NO_FORCE_REFERENCE}" if summary["newtons"] == NO_FORCE_REFERENCE else ""
    end = "" if summary["completed"] else f"\nstopped: {summary['stop_reason']}"
    scene = result.plan.scene.title or summary["scene"]
    headline = f"\n{figures}" if (figures := _headline(summary)) else ""
    shades = f"colour: measured and estimated; {truth}{newtons}"
    return f"{scene}{headline}\n{summary['bus']}, seed {summary['seed']} · {shades}{end}"


def _headline(summary: Mapping[str, Any]) -> str:
    """The figures of the run in one line; those that apply."""
    contact, shape, found = summary["contact"], summary["shape"], []
    if (off := contact["force_rms_error_n"]) is not None:
        which = "true" if contact["force_true_rms_error_n"] is not None else "measured"
        found.append(f"{which} force off its target by {100 * off / contact['force_target_n']:.1f} %")
    if (error := shape["kappa_rms_error_per_m"]) is not None:
        percent = shape["kappa_rms_error_percent"]
        found.append("curvature by " + (f"{error:.2g} 1/m" if percent is None else f"{percent:.1f} %") + " (RMS)")
    if (surface := shape.get("map")) is not None and surface["rms_error_um"] is not None:
        found.append(f"surface by {surface['rms_error_um']:.0f} µm")
    if (share := contact["contact_fraction"]) is not None:
        found.append(f"contact {100 * share:.1f} %")
    if (listened := summary.get("listen")) is not None and listened["force_max_n"] is not None:
        found.append(f"{listened['images']} images, force up to {listened['force_max_n']:.2f} N")
    if (tool := summary["calibration"]) is not None and tool["error_mm"] and None not in tool["error_mm"]:
        found.append(f"tool centre off by {math.hypot(*tool['error_mm']):.3f} mm")
    return " · ".join(found)


def _draw_tool(part: SubFigure, result: RunData) -> None:
    """Draw each coordinate of the tool centre beside the believed one, with its 95 % band, and the truth."""
    axes, found = part.subplots(), result.summary["calibration"]
    rows = list(range(3))
    for row in rows:
        value, sigma = found["tool_centre_mm"][row], found["sigma_mm"][row]
        if value is None:
            axes.annotate("not observed", (0.0, row), (4, 4), textcoords="offset points", color=ORANGE)
            continue
        moved = value - found["believed_mm"][row]
        axes.errorbar(moved, row, xerr=TWO_SIGMA * sigma, fmt="o", color=ORANGE, capsize=4, label="found, 95 %")
        axes.annotate(f"{value:.3f} mm", (moved, row), (0, 16), textcoords="offset points", ha="center")
    if found["true_mm"] is not None:
        true = np.subtract(found["true_mm"], found["believed_mm"])
        axes.plot(true, rows, "|", color=INK, markersize=20, markeredgewidth=1.6, label="truth")
    axes.axvline(0.0, color=GREY, linewidth=1.0, label="believed")
    axes.set_yticks(rows, ["x", "y", "z"])
    axes.set_ylim(-0.5, 2.7)
    axes.set(title=f"tool centre in the flange frame, {found['touches']} touches", xlabel="found − believed (mm)")
    legend(part)


def _draw_trajectory(part: SubFigure, result: RunData) -> None:
    """Draw the path of the contact and the surface recovered from it, over the true one."""
    axes = part.add_subplot(projection="3d", computed_zorder=False)
    every = drawn_rows(len(result.log["t_s"]))
    points, normals = result.log["contact_mm"][every] * 1e-3, result.log["normal"][every]
    touched = (result.log["phase"][every] == Phase.SCAN) & np.isfinite(points).all(axis=1)
    points, normals = points[touched], normals[touched]
    axes.plot(*1e3 * points.T, color=ORANGE, linewidth=0.9, zorder=3)
    shown, azimuth = ["orange: measured path"], -60.0
    if len(points):
        plane = MapPlane.of(points, normals)
        azimuth = math.degrees(math.atan2(plane.axes[0, 1], plane.axes[0, 0])) - 68.0  # the long side across the page
        if result.surface_map is not None and len(result.surface_map):
            shown.append("blue: recovered surface")
            add_sheet(axes, 1e3 * map_surface(result.surface_map, plane)[0], SKY, alpha=0.8, zorder=2)
        if (shape := result.plan.setup.truth.object) is not None and result.truth:
            shown.append("grey: true one")
            near = 1e3 * true_surface(shape, points, plane)
            axes.plot_surface(*np.moveaxis(near, 2, 0), color=GREY, alpha=0.3, linewidth=0, shade=True, zorder=1)
    frame = "base frame" if result.plan.setup.carrier is None else "frame of its carrier"
    title = f"contact in the {frame}\n{' · '.join(shown)}"
    box(part, axes, title, ("x (mm)", "y (mm)", "z (mm)"), elev=40, azim=azimuth, beside_in=1.8)


def _draw_force(part: SubFigure, result: RunData) -> None:
    axes, t = part.subplots(), result.log["t_s"]
    every = drawn_rows(len(t))
    if "force_n" in result.truth and np.any(result.truth["force_n"] > 0):
        n = min(len(t), len(result.truth["force_n"]))
        axes.plot(t[:n][every], result.truth["force_n"][:n][every], color=INK, linewidth=0.9, label="true (plant)")
    axes.plot(t[every], result.log["force_n"][every], color=BLUE, linewidth=0.9, label="measured (array)")
    target = result.summary["contact"]["force_target_n"]
    if "target_force_n" in result.log:
        axes.plot(t[every], result.log["target_force_n"][every], color=GREEN, linestyle="--", label="target")
    elif target is not None:
        axes.axhline(target, color=GREEN, linestyle="--", label=f"target {target:g} N")
    axes.set_ylim(bottom=0)
    axes.set(title="contact force", xlabel="time (s)", ylabel="force (N)")
    legend(part)


def _draw_curvature(part: SubFigure, result: RunData) -> None:
    axes = part.subplots()
    method, records = next((name, found) for name, found in result.estimates.items() if found)
    travelled = np.array([r.travelled_m for r in records]) * 1e3
    kappa = np.array([np.where(r.estimate.observed, r.estimate.kappa, np.nan) for r in records])
    with np.errstate(invalid="ignore"):  # infinite where nothing was observed
        half = TWO_SIGMA * np.array([[curvature_sigma(r.estimate, i) for i in (0, 1)] for r in records])
    lower, upper = kappa - half, kappa + half
    for i, (colour, name) in enumerate(((ORANGE, "κ₁"), (BLUE, "κ₂"))):
        axes.fill_between(travelled, lower[:, i], upper[:, i], color=colour, alpha=0.22, linewidth=0)
        axes.plot(travelled, kappa[:, i], color=colour, label=f"{name}, {method}, 95 % band")
    known = [band[np.isfinite(band)] for band in (lower, upper)]
    limits = [np.percentile(band, (20, 80)) for band in known if len(band)]  # the first answers do not set the scale
    if result.truth:
        true = result.truth["kappa_per_m"][np.searchsorted(result.log["t_s"], [r.t_s - 1e-6 for r in records])]
        axes.plot(travelled, true, color=INK, linestyle="--", label="true")
        seen = kappa[np.isfinite(kappa)]
        if len(seen):  # nor does an edge that is far sharper than every estimate
            span = max(np.ptp(seen), MIN_SPAN_PER_M)
            limits.append(np.clip(true, seen.min() - span, seen.max() + span))
    if limits:
        low, high = min(map(np.min, limits)), max(map(np.max, limits))
        spare = max(0.12 * (high - low), 0.5 * (MIN_SPAN_PER_M - (high - low)))
        axes.set_ylim(low - spare, high + spare)
    axes.set(title="principal curvatures", xlabel="path of the contact (mm)", ylabel="curvature (1/m)")
    legend(part)


def _draw_exploration(part: SubFigure, result: RunData) -> None:
    """Draw over the path the largest deviation of the height in the rectangle, and the share within the target."""
    (axes, within), explored = part.subplots(1, 2), result.summary["explore"]
    every = drawn_rows(len(result.log["t_s"]))
    path = result.log["explored_mm"][every]
    axes.plot(path, result.log["explored_sigma_um"][every], color=ORANGE, label="largest; 1000 µm: not touched yet")
    axes.axhline(explored["target_sigma_um"], color=GREEN, linestyle="--", label="target")
    log_scale(axes, "y")
    axes.set(title="stated deviation of the height", xlabel="path of the contact (mm)", ylabel="σ (µm)")
    within.plot(path, 100.0 * result.log["explored_within"][every], color=BLUE)
    within.set(
        title="rectangle within the target", xlabel="path of the contact (mm)", ylabel="share (%)", ylim=(0, 102)
    )
    legend(part)


def _draw_taxels(part: SubFigure, result: RunData) -> None:
    assert result.taxels is not None
    axes = part.subplots()
    image = axes.imshow(result.taxels, cmap="magma", origin="lower", vmin=0)
    axes.grid(visible=False)
    axes.set(title="last taxel image of the task", xlabel="column, u", ylabel="row, v")
    part.colorbar(image, ax=axes, label="counts")


def _draw_joints(part: SubFigure, result: RunData) -> None:
    """Draw a panel for each joint: in one panel joints that move alike would hide each other."""
    arm = result.plan.setup.arm
    q = joint_positions(result.log)
    assert arm is not None and q is not None
    every, joints = drawn_rows(len(q)), arm.model.joints
    t, q = result.log["t_s"][every], q[every]
    columns = min(3, len(joints))
    turns = len({joint.prismatic for joint in joints}) == 1
    grid = part.subplots(-(-len(joints) // columns), columns, squeeze=False, sharex=True, sharey=turns)
    for axes in grid.flat[len(joints) :]:
        axes.set_visible(False)
    for i, (axes, joint) in enumerate(zip(grid.flat, joints, strict=False)):
        axes.plot(t, [joint.shown(value) for value in q[:, i] - q[0, i]], color=BLUE)
        axes.set_title(f"joint {i + 1} ({joint.unit})")
    part.supxlabel("time (s)", fontsize="medium")
    part.supylabel("way from the start", fontsize="medium")
