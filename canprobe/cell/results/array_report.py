"""Report of an array's calibration: text, JSON and a picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.results.summary import without_nan
from canprobe.mechanics.touch.array_calibration.calibrate import ArrayFit
from canprobe.mechanics.touch.array_calibration.verify import Verification
from canprobe.mechanics.touch.image.calibration import ArrayCalibration


def calibration_text(fit: ArrayFit) -> str:
    """The calibration with its residuals and held-out errors, line by line."""
    c, image, noise, centroid = fit.calibration, fit.calibration.image, fit.calibration.noise, fit.calibration.centroid
    k, force, unit = c.stiffness, c.force, "nominal N" if c.nominal else "N"
    lines = [
        f"{c.array}: {c.residuals.touches} touches fitted, {fit.left_out} left out (saturated, or off the pad)",
        f"  force      {c.newtons}; scale {image.scale:.3f}" + _percent(c.residuals.force, ", held-out error"),
        f"             array ± {100 * force.array:.1f} %" + _percent(force.spread or math.nan, ", array to array ±"),
        f"  creep      {100 * force.creep:.1f} ± {100 * force.creep_sigma:.1f} % a decade of time, corrected",
        f"  stiffness  {k.moments:.4g} {unit}/m³ ± {100 * k.moments_sigma / k.moments:.1f} % by the images;"
        f" {k.depth:.4g} ± {100 * k.depth_sigma / k.depth:.1f} % by the arm's way",
        f"  arm        {1e6 * k.arm_compliance:.1f} ± {1e6 * k.arm_compliance_sigma:.1f} µm/{unit}:"
        " the difference of both",
        f"  image      blur {1e3 * image.blur:.2f} mm, crosstalk {100 * image.crosstalk:.1f} %,"
        f" memory {100 * image.memory:.1f} %",
        f"  moments    held-out error{_percent(c.residuals.moments)}; frame to frame"
        f" {100 * c.moments.frame_sigma:.1f} %",
        f"  curvature  held-out error{_percent(c.residuals.curvature)} of (K + 1/R) from one touch"
        + _percent(c.residuals.rod_curvature, "; rod, not fitted:"),
        f"  place      {1e6 * noise.scale:.0f} µm · t^{noise.power:.2f} from image to image, t = level/peak;"
        f" {1e6 * noise.slow:.0f} µm alike over {1e3 * noise.slow_way:.1f} mm of the pad; height"
        f" {1e6 * noise.height:.0f} µm",
        f"  time       latency {1e3 * centroid.latency_s:.1f} ± {1e3 * centroid.latency_sigma_s:.1f} ms;"
        f" lag up to {1e6 * centroid.lag.most:.0f} µm",
        f"  taxels     gains spread by {100 * float(np.std(fit.gains[fit.gains != 1.0])):.1f} %:"
        f" moments err by {100 * fit.gained:.1f} % with them, {100 * fit.plain:.1f} % without:"
        f" {'used' if c.gains else 'not used'}; {len(c.dead)} dead",
    ]
    if math.isfinite(float(fit.offset[0])):
        mine, its = (", ".join(f"{1e6 * x:.0f}" for x in offset) for offset in (fit.offset, fit.object_offset))
        lines.append(f"  offset     ({mine}) µm turns with the probe, ({its}) µm stays with the object")
    return "\n".join(lines)


def verification_text(calibration: ArrayCalibration, found: Verification) -> str:
    """What touches show beside a calibration, line by line."""
    c = calibration
    way, stated = found.stiffness_sigma / found.stiffness, found.stated_sigma / found.stated
    return "\n".join([
        f"{c.array}, calibrated {c.date}, last verified {c.verified or 'never'}",
        f"  moments    err by {100 * found.moments:.1f} %; the calibration says {100 * found.moments_sigma:.1f} %",
        f"  stiffness  {found.stiffness:.3g} N/m³ ± {100 * way:.0f} % by the arm's way; the calibration says"
        f" {found.stated:.3g} ± {100 * stated:.0f} %",
        "  it holds" if found.holds else "  it does not hold: type canprobe calibrate array CELL",
    ])  # fmt: skip


def _percent(value: float, before: str = "") -> str:
    return f"{before} {100 * value:.1f} %" if math.isfinite(value) else ""


def as_document(fit: ArrayFit) -> dict[str, Any]:
    """The calibration in JSON types; None where a value is not known."""
    c = fit.calibration
    document = {
        "array": c.array,
        "made_on": c.made_on,
        "newtons": c.newtons,
        "force_reference": c.force_reference,
        "touches": c.residuals.touches,
        "left_out": fit.left_out,
        "stiffness_n_m3": c.stiffness.moments,
        "stiffness_sigma_n_m3": c.stiffness.moments_sigma,
        "stiffness_by_depth_n_m3": c.stiffness.depth,
        "arm_compliance_um_n": 1e6 * c.stiffness.arm_compliance,
        "arm_compliance_sigma_um_n": 1e6 * c.stiffness.arm_compliance_sigma,
        "scale": c.image.scale,
        "blur_mm": 1e3 * c.image.blur,
        "crosstalk": c.image.crosstalk,
        "memory": c.image.memory,
        "force_error_percent": 100 * c.residuals.force,
        "force_array_percent": 100 * c.force.array,
        "creep_percent_decade": 100 * c.force.creep,
        "creep_sigma_percent_decade": 100 * c.force.creep_sigma,
        "moments_error_percent": 100 * c.residuals.moments,
        "curvature_error_percent": 100 * c.residuals.curvature,
        "rod_curvature_error_percent": 100 * c.residuals.rod_curvature,
        "image_noise_um": 1e6 * c.noise.scale,
        "image_noise_power": c.noise.power,
        "slow_noise_um": 1e6 * c.noise.slow,
        "slow_noise_way_mm": 1e3 * c.noise.slow_way,
        "height_noise_um": 1e6 * c.noise.height,
        "latency_ms": 1e3 * c.centroid.latency_s,
        "uses_gains": bool(c.gains),
        "dead": [list(place) for place in c.dead],
    }
    return {name: without_nan(value) for name, value in document.items()}


def draw_calibration(fit: ArrayFit, path: Path) -> None:
    """Draw held-out errors of moments and curvatures, centroids by load, and gains of the taxels."""
    from canprobe.cell.results.picture import BLUE, GREY, INK, ORANGE, legend, log_scale, picture

    c = fit.calibration
    title = (
        f"{c.array}: errors of touches that the fit has not seen, scatter of centroids, gains of taxels\n{c.newtons}"
    )
    colours = {"plane": BLUE, "ball": ORANGE, "rod": GREY}
    names = np.array([s.dwell.name for s in fit.touches])
    with picture(path, title, 3.6) as figure:
        moments, curvatures, scatter, gains = figure.subplots(1, 4)
        for name in dict.fromkeys(names.tolist()):
            mine = names == name
            forces = fit.forces[mine]
            for axes, errors in ((moments, fit.errors[mine, :2]), (curvatures, fit.curvature_errors[mine])):
                axes.scatter(np.repeat(forces, 2), 100.0 * errors.reshape(-1), s=8, color=colours[name], label=name)
        for axes, what in ((moments, "moments, %"), (curvatures, "curvature, % of K + 1/R")):
            axes.axhline(0.0, color=INK, linewidth=0.8)
            axes.set(title=what, xlabel="force, nominal N" if c.nominal else "force, N")
        t = np.array([s.lightness for s in fit.touches])
        scatter.scatter(t, 1e6 * fit.scatter, s=8, color=GREY, label="centroids of a touch")
        fine = np.geomspace(t.min(), t.max(), 50)
        scatter.plot(fine, [1e6 * c.noise.image(x) for x in fine], color=INK, label="fitted law")
        log_scale(scatter, "xy")
        scatter.set(title="centroid scatter, µm", xlabel="level over peak")
        shown = gains.imshow(np.where(fit.gains == 1.0, np.nan, fit.gains), cmap="PuOr", vmin=0.9, vmax=1.1)
        figure.colorbar(shown, ax=gains, shrink=0.7)
        gains.set(title="gains of taxels")
        gains.grid(visible=False)
        legend(figure)
