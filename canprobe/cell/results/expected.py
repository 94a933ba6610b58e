"""Expected figures of the packaged scenes: `scenes/expected.json`, which `python docs/generate.py` takes from the
measurements of `python docs/measure.py`.

A figure is the lowest and the highest value over some seeds of the emulation. It shows whether a run is as good as it
should be: the scenes differ in their accuracy.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

FIGURES = {
    "contact": ("contact", "%"),
    "force": ("force", "%"),
    "curvature": ("curvature", "%"),
    "curvature_per_m": ("curvature", "1/m"),
    "normal": ("normal", "deg"),
    "position": ("position", "mm"),
    "tool": ("tool centre", "mm"),
}
"""Name and unit of each figure. All but the contact are RMS over the scan: of the true force less its target, and of
the errors of the others."""
LISTED_FIGURES = ("force", "curvature", "curvature_per_m", "tool")
"""Figures in the list of scenes."""


def read_expected() -> dict[str, Any]:
    """The whole file: `seeds`, and `scenes` with the figures of each."""
    file = resources.files("canprobe") / "scenes" / "expected.json"
    read: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return read


def figures_of(summary: Mapping[str, Any]) -> dict[str, float]:
    """The figures of one run that apply, from its summary."""
    contact, shape, tool = summary["contact"], summary["shape"], summary["calibration"]
    percent, target = shape["kappa_rms_error_percent"], contact["force_target_n"]
    found = {
        "contact": contact["contact_fraction"],
        "force": contact["force_rms_error_n"],
        "curvature": percent,
        "curvature_per_m": shape["kappa_rms_error_per_m"] if percent is None else None,
        "normal": shape["normal_rms_deg"],
        "position": shape["position_rms_mm"],
        "tool": None if tool is None else sum(error**2 for error in tool["error_mm"]) ** 0.5,
    }
    scale = {"contact": 100.0, "force": 100.0 / (target or 1.0)}
    return {name: scale.get(name, 1.0) * value for name, value in found.items() if value is not None}


def range_text(name: str, between: Sequence[float]) -> str:
    """A figure with its unit, as `3.2–3.7 %`; one number where both ends show the same."""
    low, high = (f"{value:.{1 if FIGURES[name][1] == '%' else 3}f}" for value in between)
    return f"{low if low == high else f'{low}–{high}'} {FIGURES[name][1]}"


def expected_text(figures: Mapping[str, Sequence[float]], names: Sequence[str] = tuple(FIGURES)) -> str:
    """Figures of one scene as `force 3.2–3.7 %, curvature 0.5–0.6 %`; empty where it has none."""
    return ", ".join(f"{FIGURES[name][0]} {range_text(name, figures[name])}" for name in names if name in figures)


def seeds_text(expected: Mapping[str, Any]) -> str:
    """The seeds behind the figures, as `0, 1, 2`."""
    return ", ".join(map(str, expected["seeds"]))
