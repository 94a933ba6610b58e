"""The geometry that a scene describes, in SI units and the base frame, and what a calibration found of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.scene.hardware import Vec3
from canprobe.cell.scene.load import Reader, read_toml, with_writer, written_by_line
from canprobe.cell.scene.model import ObjectSettings, PlantSettings, ProbeSettings, Scene, TaskSettings
from canprobe.cell.scene.surface_files import object_of_file
from canprobe.errors import SceneError
from canprobe.mechanics.robot.chain import rotation_rpy, tool_z_offset
from canprobe.mechanics.robot.tool_calibration import ToolEstimate
from canprobe.mechanics.touch.objects import OBJECT_PARAMETERS, make_object
from canprobe.mechanics.touch.shapes import PlacedShape

Array = NDArray[np.float64]


def transform(position_mm: Vec3, rotation_deg: Vec3) -> Array:
    """(4, 4), m, of a position, mm, and roll, pitch and yaw about the fixed axes, deg."""
    T = np.eye(4)
    T[:3, :3] = rotation_rpy(*(math.radians(angle) for angle in rotation_deg))
    T[:3, 3] = np.array(position_mm) * 1e-3
    return T


def T_base_object(settings: ObjectSettings) -> Array:
    """Pose of the object frame, (4, 4), m: origin on the surface, z outward."""
    return transform(settings.position_mm, settings.rotation_deg)


def true_object(settings: ObjectSettings) -> PlacedShape:
    """The object that a scene describes.

    Raises:
        ValueError: for a matrix that describes no surface through the object's origin with z outward, or a file that
            holds none.
        UsageError: a mesh, and no trimesh is installed.
    """
    if settings.file is not None:
        return object_of_file(settings, T_base_object(settings))
    values: dict[str, object] = {"matrix": np.array(settings.matrix), "angle": math.radians(settings.angle_deg or 0.0)}
    params = {
        name: values[name] if name in values else getattr(settings, f"{name}_mm") * 1e-3
        for name in OBJECT_PARAMETERS[settings.kind]
    }
    return make_object(settings.kind, T_base_object=T_base_object(settings), **params)


def T_flange_probe(probe: ProbeSettings) -> Array:
    """Frame of the probe's centre on the flange, (4, 4), m; z is the pole."""
    T = tool_z_offset(probe.centre_offset_mm)
    T[:2, 3] = np.array(probe.centre_lateral_mm) * 1e-3
    return T


def approach_normal(task: TaskSettings) -> Array:
    """Unit outward normal that the approach expects, (3,)."""
    normal = np.array(task.approach_normal)
    unit: Array = normal / np.linalg.norm(normal)
    return unit


def scan_axes(task: TaskSettings) -> Array:
    """Axes of the scan plane, (3, 3): rows heading, across, approach normal; right-handed.

    The heading is given in the base xy-plane and carried into the plane perpendicular to the approach normal.
    """
    normal = approach_normal(task)
    heading = math.radians(task.heading_deg)
    along = np.array((math.cos(heading), math.sin(heading), 0.0))
    along -= normal * float(normal @ along)
    along /= np.linalg.norm(along)
    return np.array((along, np.cross(normal, along), normal))


def expected_ball(task: TaskSettings) -> tuple[Array, float]:
    """Centre (3,), m, base frame, and radius, m, of the ball: its top is at `start_mm`."""
    radius = task.ball_radius_mm * 1e-3
    return np.array(task.start_mm) * 1e-3 - radius * approach_normal(task), radius


# What a calibration found: for the summary, for people, and as a file that other scenes take.

FILE = "tool.toml"
KEYS = ("centre_offset_mm", "centre_lateral_mm")


def summarise_calibration(scene: Scene, estimate: ToolEstimate | None) -> dict[str, Any] | None:
    """The section ``calibration`` of ``summary.json``; None without an estimate."""
    if estimate is None or scene.probe is None:
        return None
    believed, found = T_flange_probe(scene.probe)[:3, 3] * 1e3, estimate.t_flange * 1e3
    emulated = scene.arm is not None and scene.arm.emulated
    true = believed + np.array((scene.plant or PlantSettings()).tool_error_mm) if emulated else None
    return {
        "touches": estimate.touches,
        "tool_centre_mm": _known(found),
        "sigma_mm": _known(estimate.sigma * 1e3),
        "observed": [bool(one) for one in estimate.observed],
        "believed_mm": believed.tolist(),
        "true_mm": None if true is None else true.tolist(),
        "error_mm": None if true is None else _known(found - true),
        "ball_centre_mm": (estimate.c_base * 1e3).tolist(),
        "ball_moved_mm": ((estimate.c_base - expected_ball(scene.task)[0]) * 1e3).tolist(),
        "radii_error_mm": estimate.radii_error * 1e3,
        "array_tilt_mrad": (estimate.tilt * 1e3).tolist(),
        "condition_number": estimate.condition_number if np.isfinite(estimate.condition_number) else None,
        "residual_along_mm": estimate.along_rms * 1e3,
        "residual_across_mm": estimate.across_rms * 1e3,
        "chi2_per_dof": estimate.chi2_per_dof,
    }


def _known(values: Array) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]


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
        f"# deviation of x, y, z: {sigma} mm. For a scene's own [probe], or: canprobe run SCENE --tool THIS_FILE\n\n"
        f"{written_by_line()}\n"
        f"[probe]\ncentre_offset_mm = {z:.4f}\ncentre_lateral_mm = [{x:.4f}, {y:.4f}]\n"
    )


def with_tool(scene: Scene, path: Path | str) -> Scene:
    """The scene with the probe's centre from a calibration's file; a real tool stays where the scene has it.

    The emulated probe does not move: what the controller believes changes, and the plant's error with it.

    Args:
        scene: with a probe.
        path: ``tool.toml`` of a calibration.

    Raises:
        SceneError: the file cannot be read or has other content, or the scene has no probe.
    """
    (document, file), reader = with_writer(read_toml(Path(path), str(path)), str(path)), Reader()
    table = document.get("probe")
    if set(document) != {"probe"} or not isinstance(table, dict) or set(table) != set(KEYS):
        raise SceneError([f"{file}: expected the section [probe] with {' and '.join(KEYS)}, and nothing else"])
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
