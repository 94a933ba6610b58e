"""The figure of a run: contact trajectory like the paper's, force, curvature with its band, taxel image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from canprobe.cell.tasks.shape import ShapeRecord
from canprobe.results import RunResult
from canprobe.scene_geometry import true_object

Array = NDArray[np.float64]
INK, TRUE, ACCENT, SECOND, FAINT = "#1f2933", "#8a94a0", "#c2410c", "#0f6e84", "#d9dee4"
TWO_SIGMA = 1.96


def draw_run(result: RunResult, path: Path) -> None:
    """Draw what the run has and write a PNG; panels without data are left out."""
    panels = _panels(result)
    if not panels:
        return
    figure = Figure(figsize=(12.0, 7.6), dpi=110, layout="constrained")
    figure.suptitle(_title(result), x=0.01, ha="left", fontsize=11, color=INK)
    grid = figure.add_gridspec(2, 6)
    places = _places(len(panels), grid)
    for (kind, draw), place in zip(panels, places, strict=False):
        axes = figure.add_subplot(place, projection="3d" if kind == "3d" else None)
        draw(axes, result)
    figure.savefig(path)


def _places(count: int, grid: Any) -> list[Any]:
    if count >= 4:
        return [grid[0, 0:3], grid[0, 3:6], grid[1, 0:4], grid[1, 4:6]]
    if count == 3:
        return [grid[0, 0:3], grid[0, 3:6], grid[1, 0:6]]
    return [grid[0, 0:6], grid[1, 0:6]][:count]


def _panels(result: RunResult) -> list[tuple[str, Any]]:
    panels: list[tuple[str, Any]] = []
    scanning = any(result.estimates.values())
    if "contact_mm" in result.log and scanning:
        panels.append(("3d", _draw_trajectory))
    if "force_n" in result.log:
        panels.append(("2d", _draw_force))
    if scanning:
        panels.append(("2d", _draw_curvature))
    if result.taxels is not None:
        panels.append(("2d", _draw_taxels))
    if result.summary.get("calibration") is not None:
        panels.append(("2d", _draw_tool))
    elif "q_rad" in result.log and not scanning:
        panels.append(("2d", _draw_joints))
    return panels


def _draw_tool(axes: Axes, result: RunResult) -> None:
    """Each coordinate of the tool centre beside what was believed, with its 95 % band, and the truth."""
    found = result.summary["calibration"]
    rows = list(range(3))
    for row in rows:
        value, sigma = found["tool_centre_mm"][row], found["sigma_mm"][row]
        if value is None:
            axes.text(0.0, row, " not observed", va="center", color=ACCENT)
            continue
        moved = value - found["believed_mm"][row]
        axes.errorbar(moved, row, xerr=TWO_SIGMA * sigma, fmt="o", color=ACCENT, capsize=4, label="found, 95 %")
        axes.annotate(f"{value:.3f} mm", (moved, row), (0, 14), textcoords="offset points", ha="center", color=INK)
    if found["true_mm"] is not None:
        true = np.subtract(found["true_mm"], found["believed_mm"])
        axes.plot(true, rows, "|", color=TRUE, markersize=26, markeredgewidth=2.0, label="truth")
    axes.axvline(0.0, color=FAINT, linewidth=1.0)
    axes.set_yticks(rows, ["x", "y", "z"])
    axes.set_ylim(-0.6, 2.6)
    title = f"Tool centre in the flange frame, {found['touches']} touches"
    _style(axes, title, "found − believed (mm)", "")
    handles, labels = axes.get_legend_handles_labels()
    shown = dict(zip(labels, handles, strict=True))
    axes.legend(shown.values(), shown.keys(), frameon=False, fontsize=8, loc="lower right")


def _title(result: RunResult) -> str:
    summary = result.summary
    source = "truth" if result.truth else "measured"
    end = "" if summary["completed"] else f" · stopped: {summary['stop_reason']}"
    title = result.plan.scene.title or summary["scene"]
    return f"{title}\n{summary['bus']}, seed {summary['seed']} · source: {source}{end}"


def _style(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(color=FAINT, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _scan_rows(result: RunResult) -> NDArray[np.bool_]:
    return np.asarray(result.log["phase"] == 3)


def _draw_trajectory(axes: Any, result: RunResult) -> None:
    rows = _scan_rows(result)
    points = result.log["contact_mm"][rows]
    points = points[np.isfinite(points).all(axis=1)]
    axes.plot(*points.T, color=ACCENT, linewidth=1.1, label="contact, measured")
    if result.plan.scene.object is not None and result.truth:
        x, y, z = _surface_near(result, points)
        axes.plot_surface(x, y, z, color=TRUE, alpha=0.22, linewidth=0, shade=True)
    axes.set_title("contact trajectory in the base frame", loc="left", fontsize=10, color=INK)
    axes.set_xlabel("x (mm)")
    axes.set_ylabel("y (mm)")
    axes.set_zlabel("z (mm)")
    axes.set_aspect("equal")
    axes.set_box_aspect(axes.get_box_aspect(), zoom=1.35) if hasattr(axes, "get_box_aspect") else None
    axes.view_init(elev=22, azim=-150)
    axes.locator_params(nbins=4)
    axes.tick_params(labelsize=8)


def _surface_near(result: RunResult, points: Array) -> tuple[Array, Array, Array]:
    """True surface (mm) under the path: closest points of a grid above it."""
    shape = true_object(result.plan.scene.object)  # type: ignore[arg-type]
    low, high = points.min(axis=0) - 6, points.max(axis=0) + 6
    xs, ys = np.meshgrid(np.linspace(low[0], high[0], 36), np.linspace(low[1], high[1], 36))
    grid = np.stack((xs, ys, np.full_like(xs, high[2])), axis=-1)
    feet = np.array([[shape.closest(g * 1e-3).point * 1e3 for g in row] for row in grid])
    return feet[..., 0], feet[..., 1], feet[..., 2]


def _draw_force(axes: Axes, result: RunResult) -> None:
    t = result.log["t_s"]
    axes.plot(t, result.log["force_n"], color=SECOND, linewidth=0.7, alpha=0.75, label="measured by the array")
    if "force" in result.truth and np.any(result.truth["force"] > 0):
        n = min(len(t), len(result.truth["force"]))
        axes.plot(t[:n], result.truth["force"][:n], color=INK, linewidth=0.8, label="true, from the plant")
    target = result.summary["contact"]["force_target_n"]
    if target is not None:
        axes.axhline(target, color=ACCENT, linewidth=1.0, linestyle="--", label=f"target {target:g} N")
    axes.legend(frameon=False, fontsize=8, loc="lower center")
    axes.set_ylim(bottom=0)
    _style(axes, "contact force", "time (s)", "force (N)")


def _draw_curvature(axes: Axes, result: RunResult) -> None:
    method, records = next(iter(result.estimates.items()))
    travelled = np.array([r.travelled_m for r in records]) * 1e3
    kappa = np.array([np.where(r.estimate.observed, r.estimate.kappa, np.nan) for r in records])
    sigma = np.array([_kappa_sigma(r) for r in records])
    for i, (colour, name) in enumerate(((ACCENT, "κ₁"), (SECOND, "κ₂"))):
        axes.fill_between(
            travelled,
            kappa[:, i] - TWO_SIGMA * sigma[:, i],
            kappa[:, i] + TWO_SIGMA * sigma[:, i],
            color=colour,
            alpha=0.22,
            linewidth=0,
        )
        axes.plot(travelled, kappa[:, i], color=colour, linewidth=0.9, label=f"{name}, {method}, 95 % band")
    if result.truth:
        rows = np.searchsorted(result.log["t_s"], [r.t_s - 1e-6 for r in records])
        true = result.truth["kappa"][rows]
        axes.plot(travelled, true, color=INK, linewidth=1.0, linestyle="--", label=None)
        axes.plot([], [], color=INK, linewidth=1.0, linestyle="--", label="true")
        centre, spread = true.mean(), max(np.ptp(true), 10.0)
        axes.set_ylim(centre - 1.1 * spread, centre + 1.1 * spread)
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="center right")
    _style(axes, "principal curvatures", "path of the contact (mm)", "curvature (1/m)")


def _kappa_sigma(record: ShapeRecord) -> Array:
    """Standard deviations (2,) of the principal curvatures, from the covariance of K along its directions."""
    estimate = record.estimate
    axes = estimate.T_frame_contact[:3, :2]
    sigmas = []
    for direction in estimate.directions:
        d = np.asarray(direction, dtype=float)
        u, v = (axes.T @ d) if d.size == 3 else d
        gradient = np.array((u * u, 2 * u * v, v * v))
        with np.errstate(invalid="ignore"):  # infinite where nothing was observed
            sigmas.append(float(np.sqrt(max(gradient @ estimate.covariance @ gradient, 0.0))))
    return np.array(sigmas)


def _draw_taxels(axes: Axes, result: RunResult) -> None:
    assert result.taxels is not None
    image = axes.imshow(result.taxels, cmap="magma", origin="lower", vmin=0)
    axes.set_title("last taxel image of the task (counts)", loc="left", fontsize=10, color=INK)
    axes.set_xlabel("column, u")
    axes.set_ylabel("row, v")
    axes.figure.colorbar(image, ax=axes, shrink=0.8)


def _draw_joints(axes: Axes, result: RunResult) -> None:
    t, q = result.log["t_s"], np.degrees(result.log["q_rad"])
    for i in range(q.shape[1]):
        axes.plot(t, q[:, i] - q[0, i], linewidth=0.9, label=f"J{i + 1}")
    axes.legend(frameon=False, fontsize=8, ncols=6, loc="upper center")
    _style(axes, "joint angles from their start", "time (s)", "angle (deg)")
