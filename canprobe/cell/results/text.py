"""Text of a summary, which `canprobe run` and `canprobe replay` print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from canprobe.cell.results.tool_file import calibration_lines
from canprobe.cell.session.target import VIRTUAL


def _figure(value: float | None, unit: str, digits: int = 2) -> str:
    return "not observed" if value is None else f"{value:.{digits}f} {unit}".rstrip()


def summary_text(summary: dict[str, Any], out: Path | None, *, full: bool = True) -> str:
    """A summary as text.

    Args:
        summary: content of ``summary.json``.
        out: folder of the run; None: no line about it.
        full: whether times, choices, the measured force and other estimators have their lines too; else it is the
            verdict, with everything that was noted or warned of.
    """
    contact, shape, cycle = summary["contact"], summary["shape"], summary["cycle"]
    wall_s = f"{summary['wall_time_s']:.2f} s"
    pace = f"{summary['realtime_factor']:.1f} × real time" if summary["bus"] in VIRTUAL else "real time"
    rate = "no cycle" if cycle["rate_hz"] is None else f"{cycle['cycles']} at {cycle['rate_hz']:.4g} Hz"
    lines = [
        f"{summary['scene']} on {summary['bus']}, seed {summary['seed']}: "
        + ("done" if summary["completed"] else f"stopped: {summary['stop_reason']}"),
        f"  time       {summary['sim_time_s']:.2f} s in {wall_s} ({pace})",
        f"  cycle      {rate}, {cycle['overruns']} overruns,"
        f" {cycle['missed_pdos']} missed PDOs, {cycle['torn_frames']} torn frames",
    ]
    if full:
        lines += [f"  plan       {choice}" for choice in summary.get("choices", ())]
    if (summary.get("newtons") or "").startswith("nominal"):
        lines.append(
            f"  newtons    {summary['newtons']} of the array; forces and stiffness are as good as its full scale"
        )
    if contact["force_rms_error_n"] is not None:
        lines += force_lines(contact) if full else force_lines(contact)[:1]
    if contact["speed_mean_m_s"] is not None:
        lines.append(
            f"  contact    {100 * contact['contact_fraction']:.1f} % of the scan at"
            f" {contact['speed_mean_m_s'] * 1e3:.2f} mm/s"
        )
    watched = (summary.get("witnesses") or {}).get("depth_watched_fraction")
    if full and watched is not None:
        lines.append(f"  witness    the depth watched the force at {100 * watched:.0f} % of the contacts")
    if contact["losses"]:
        lines.append(f"  {losses_text(contact['losses'])}")
    if summary.get("listen") is not None:
        lines.append(f"  images     {listened_text(summary['listen'])}")
    if shape["method"] is not None:
        lines += shape_lines(shape, full=full)
    if summary.get("explore") is not None:
        lines.append(f"  explored   {explored_text(summary['explore'])}")
    if summary.get("calibration") is not None:
        lines += calibration_lines(summary["calibration"])
    lines += bridge_lines(summary.get("bridges") or {})
    lines += [f"  noted      {fault}" for fault in summary["faults"]]
    lines += [f"  warning    {warning}" for warning in summary.get("warnings", ())]
    if out is not None:
        lines.append(folder_line(out))
    return "\n".join(lines)


def folder_line(out: Path) -> str:
    """The folder of a run's files, the last line of its summary."""
    return f"  files      {out}"


def force_lines(contact: Mapping[str, Any]) -> list[str]:
    """The force of a touch as text: how it was held, how well it is known, and its error where the truth is known."""
    target, off = contact["force_target_n"], contact["force_rms_error_n"]
    error, sigma = contact.get("force_true_rms_error_n"), contact.get("force_sigma_n")
    which = "true force" if error is not None else "measured force"
    lines = [
        f"  force      target {target:.4g} N, {which} off it by {off:.3f} N RMS ({100 * off / target:.1f} %),"
        f" highest {contact['force_max_n']:.2f} N"
    ]
    if sigma is not None:
        parts = [f"{name} {100 * part / target:.1f} %" for name, part in contact["force_sigma_parts_n"].items() if part]
        lines.append(f"             measured to ± {100 * sigma / target:.1f} % over a second (1σ: {', '.join(parts)})")
    if contact.get("force_lower_bound_fraction"):
        lines.append(
            f"             in {100 * contact['force_lower_bound_fraction']:.0f} % of the samples the array saturates or"
            " ends below the contact: the true force is above the measured one"
        )
    if error is None:
        return [*lines, "             no true force is known here: how wrong the measured one is does not show"]
    bias, share = contact["force_true_bias_n"], contact.get("force_within_2_sigma_fraction")
    within = "" if share is None else f", within 2σ in {100 * share:.0f} % of the seconds"
    return [
        *lines,
        f"             measured less true: mean {bias:+.3f} N ({100 * bias / target:+.1f} %),"
        f" RMS {error:.3f} N ({100 * error / target:.1f} %){within}",
    ]


def losses_text(losses: Sequence[Mapping[str, float | None]]) -> str:
    """The losses of contact in a scan in words: how many, and whether each was regained."""
    told = ", ".join(
        f"not regained within {loss['searched_mm']:.1f} mm"
        if loss["regained_after_ms"] is None
        else f"regained after {loss['regained_after_ms']:.0f} ms and {loss['searched_mm']:.1f} mm"
        for loss in losses
    )
    return f"contact lost {len(losses)} time{'s' * (len(losses) > 1)}: {told}"


def bridge_lines(bridges: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Samples, drops and errors of each bridge, as text."""
    return [
        f"  bridge     {name}: {status['samples']} samples, {status['dropped']} dropped; "
        + (f"failed: {status['error']}" if status["error"] is not None else f"{status['where']}")
        for name, status in bridges.items()
    ]


def curvature_text(values: Sequence[float | None] | None) -> str:
    """Principal curvatures as text, with their unit."""
    if values is None:
        return "–"
    observed = ", ".join(f"{v:.2f}" for v in values if v is not None)
    if not observed:
        return "not observed"
    return f"{observed} 1/m" + (", the other one not observed" if None in values else "")


def listened_text(listened: Mapping[str, Any]) -> str:
    """The section ``listen`` of a summary as text."""
    if not listened["images"]:
        return "none came"
    rate = "" if listened["images_per_s"] is None else f" ({listened['images_per_s']:.4g} a second)"
    force = listened["force_max_n"]
    shown = (
        "force not measured" if force is None else f"force {listened['force_mean_n']:.2f} N mean, {force:.2f} N highest"
    )
    return f"{listened['images']}{rate}, {shown}"


def shape_lines(shape: dict[str, Any], *, full: bool = True) -> list[str]:
    """The section ``shape`` of a summary as text; or one line, the curvature with its error over the scan."""
    estimated, true = curvature_text(shape["kappa_est_per_m"]), curvature_text(shape["kappa_true_per_m"])
    curvature = f"  curvature  {estimated}; true {true}"
    error, percent = shape.get("kappa_rms_error_per_m"), shape.get("kappa_rms_error_percent")
    if not full and error is not None:
        curvature += f"; RMS error {error:.2f} 1/m" + (f" ({percent:.1f} %)" if percent is not None else "")
    if not full:
        return [curvature]
    lines = [curvature, *method_lines(shape.get("methods", {}))]
    if (surface := shape.get("map")) is not None:
        lines.append(f"  map        {_map_text(surface)}")
    return lines


def explored_text(explored: Mapping[str, Any]) -> str:
    """The section ``explore`` of a summary as text."""
    after = f"after {explored['path_mm']:.0f} mm in {explored['time_s']:.1f} s"
    target, largest = f"target {explored['target_sigma_um']:g} µm", explored["sigma_max_um"]
    if explored["reached"]:
        return f"σ of the height at most {largest:.0f} µm, {target}, reached {after}"
    at_most = f"σ of the height up to {largest:.0f} µm" if largest is not None else "a part was not touched"
    return (
        f"{100 * explored['done_fraction']:.0f} % within {target}, {at_most} {after}; not reached:"
        f" {explored['why_not']}"
    )


def method_lines(methods: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The errors of estimators as text, a line for each."""
    lines = []
    for name, score in methods.items():
        if score["estimates"] == 0:
            lines.append(f"    {name:<10} not scored: no estimate of both curvatures after the first 20 mm")
            continue
        percent = score["kappa_rms_error_percent"]
        lines.append(
            f"    {name:<10} RMS error {_figure(score['kappa_rms_error_per_m'], '1/m')}"
            + (f" ({percent:.1f} %)" if percent is not None else "")
            + f", normal {_figure(score['normal_rms_deg'], 'deg', 3)},"
            f" position {_figure(score['position_rms_mm'], 'mm', 3)}"
            + (f", with the patch in {100 * score['patch_fraction']:.0f} %" if score["patch_fraction"] else "")
        )
    return lines


def _map_text(surface: Mapping[str, Any]) -> str:
    """The section ``shape.map`` of a summary as text."""
    if surface["sigma_um"] is None:
        return f"{surface['contacts']} contacts, no surface"
    off = surface["rms_error_um"]
    return (
        f"{surface['contacts']} contacts in {surface['nodes']} nodes, σ {surface['sigma_relative_um']:.0f} µm,"
        f" with tool and arm {surface['sigma_um']:.0f} µm"
        + (f"; RMS error {off:.0f} µm" if off is not None else "")
        + f"; contacts disagree on {100 * surface['disagree_fraction']:.0f} %"
    )
