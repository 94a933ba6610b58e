"""The choice among the settings of the whole cell: those whose errors are small enough, and the default beside them."""

from __future__ import annotations

from collections.abc import Iterable

from canprobe.cell.scene.load import load_scene
from canprobe.lab.studies.result import Row

FIDELITIES = ("ideal", "dynamic")
ENOUGH = {"curvature_percent": 2.0, "normal_deg": 0.2, "force_percent": 6.0}
"""Small enough errors: the goal of the servo's force at 25 mm/s; shape and normal assumed."""
MEASURES = tuple(ENOUGH)
CLASSICAL, FD, FASTER = "classical", "FD", "8 Mbit/s"
REAL = (CLASSICAL, FD)


def good(rows: Iterable[Row], fidelity: str) -> list[Row]:
    """The rows of a fidelity on a classical bus that are good enough, the cheapest first."""
    mine = [r for r in rows if r["fidelity"] == fidelity and all(r.get(m) is not None for m in MEASURES)]
    mine = [r for r in mine if r["bus"] == CLASSICAL and r["stiff"] == "holds"]
    found = [r for r in mine if all(r[m] <= most for m, most in ENOUGH.items())]
    return sorted(found, key=lambda r: float(r["cost_ms_per_s"]))


def default_of(rows: Iterable[Row], fidelity: str) -> Row | None:
    """The row of the defaults of scene `cylinder`, on a plant of a fidelity."""
    scene = load_scene("cylinder")
    assert scene.sensor is not None and scene.shape is not None
    mine = scene.cycle.rate_hz, scene.sensor.mode, scene.shape.method, fidelity
    return next((r for r in rows if (r["rate_hz"], r["mode"], r["method"], r["fidelity"]) == mine), None)
