"""The result of a tool calibration: in the summary, as text, and as a file that other scenes take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.scene.geometry import T_flange_probe, expected_ball
from canprobe.cell.scene.model import PlantSettings, ProbeSettings, Scene
from canprobe.cell.scene.reader import Reader
from canprobe.cell.scene.toml_files import read_toml, with_writer, written_by_line
from canprobe.errors import SceneError
from canprobe.mechanics.robot.tool_calibration import ToolEstimate

FILE = "tool.toml"
KEYS = ("centre_offset_mm", "centre_lateral_mm", "position_sd_mm")


def summarise_calibration(scene: Scene, estimate: ToolEstimate | None) -> dict[str, Any] | None:
    """The section ``calibration`` of ``summary.json``, not finite where not observed; None without an estimate."""
    if estimate is None or scene.probe is None:
        return None
    believed, found = T_flange_probe(scene.probe)[:3, 3] * 1e3, estimate.t_flange * 1e3
    emulated = scene.arm is not None and scene.arm.emulated
    true = believed + np.array((scene.plant or PlantSettings()).tool_error_mm) if emulated else None
    return {
        "touches": estimate.touches,
        "tool_centre_mm": found.tolist(),
        "sigma_mm": (estimate.sigma * 1e3).tolist(),
        "observed": [bool(one) for one in estimate.observed],
        "believed_mm": believed.tolist(),
        "true_mm": None if true is None else true.tolist(),
        "error_mm": None if true is None else (found - true).tolist(),
        "ball_centre_mm": (estimate.c_base * 1e3).tolist(),
        "ball_moved_mm": ((estimate.c_base - expected_ball(scene.task)[0]) * 1e3).tolist(),
        "radii_error_mm": estimate.radii_error * 1e3,
        "array_tilt_mrad": (estimate.tilt * 1e3).tolist(),
        "condition_number": estimate.condition_number,
        "residual_along_mm": estimate.along_rms * 1e3,
        "residual_across_mm": estimate.across_rms * 1e3,
        "chi2_per_dof": estimate.chi2_per_dof,
    }


def calibration_lines(found: Mapping[str, Any]) -> list[str]:
    """The section ``calibration`` as lines for people."""
    lines = [f"  tool       {found['touches']} touches, condition number {_number(found['condition_number'], '.0f')}"]
    true, errors = found["true_mm"] or [None] * 3, found["error_mm"] or [None] * 3
    columns = zip("xyz", found["tool_centre_mm"], found["sigma_mm"], found["believed_mm"], true, errors, strict=True)
    for axis, value, sigma, believed, truth, error in columns:
        unknown = f"not observed (1σ {_number(sigma, '.2f')} mm)"
        line = unknown if value is None else f"{value:8.3f} ± {sigma:.3f} mm"
        line += f", believed {believed:.3f}"
        if truth is not None:
            line += f", true {truth:.3f}" + (f", error {error:+.3f}" if error is not None else "")
        lines.append(f"    {axis}        {line}")
    return lines


def _number(value: float | None, form: str) -> str:
    return "infinite" if value is None else format(value, form)


def tool_text(found: Mapping[str, Any], name: str) -> str | None:
    """The content of ``tool.toml``; None where a coordinate was not observed."""
    if not all(found["observed"]):
        return None
    x, y, z = found["tool_centre_mm"]
    sigma = ", ".join(f"{value:.3f}" for value in found["sigma_mm"])
    return (
        f"# The probe's centre on the flange, by {found['touches']} touches of a ball (scene {name}); standard\n"
        f"# deviation of x, y, z: {sigma} mm, of which the file states the largest.\n"
        f"# For a scene's own [probe], or: canprobe run SCENE --tool THIS_FILE\n\n"
        f"{written_by_line()}\n"
        f"[probe]\ncentre_offset_mm = {z:.4f}\ncentre_lateral_mm = [{x:.4f}, {y:.4f}]\n"
        f"position_sd_mm = {max(found['sigma_mm']):.3f}\n"
    )


def with_tool(scene: Scene, path: Path | str) -> Scene:
    """The scene with the probe's centre from a calibration's file; a real tool stays where the scene has it.

    The emulated probe does not move: the controller's belief changes, and the plant's error with it.

    Args:
        scene: a scene with a probe.
        path: ``tool.toml`` of a calibration.

    Raises:
        SceneError: when the file cannot be read or has other content, or the scene has no probe.
    """
    (document, file), reader = with_writer(read_toml(Path(path), str(path)), str(path)), Reader()
    table = document.get("probe")
    if set(document) != {"probe"} or not isinstance(table, dict) or not set(KEYS[:2]) <= set(table) <= set(KEYS):
        raise SceneError([f"{file}: expected the section [probe] with {', '.join(KEYS)}, and nothing else"])
    found = reader.section(ProbeSettings, table, "probe")
    if reader.problems:
        raise SceneError([f"{file}: {problem}" for problem in reader.problems])
    if scene.probe is None:
        raise SceneError([f"{path}: scene {scene.name} has no probe that could be calibrated"])
    probe = replace(scene.probe, **{key: getattr(found, key) for key in KEYS})
    if scene.plant is None or scene.arm is None or not scene.arm.emulated:
        return replace(scene, probe=probe)
    moved = (T_flange_probe(probe) - T_flange_probe(scene.probe))[:3, 3] * 1e3
    x, y, z = (np.array(scene.plant.tool_error_mm) - moved).tolist()
    return replace(scene, probe=probe, plant=replace(scene.plant, tool_error_mm=(x, y, z)))
