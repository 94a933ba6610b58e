"""Random scenes: object, place, path, and effects of the emulated array."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import ObjectSettings, PlantSettings, Scene
from canprobe.cell.scene.resolve import LAYER_STIFFNESS

_PLACE_MM = (-170.0, -175.0, 300.0)
"""Place where the arm reaches in all directions, mm."""


def random_scene(number: int, duration_s: float) -> Scene:
    """The random scene of a number; the kinds of objects take turns."""
    rng = np.random.default_rng([24, number])

    def within(low: float, high: float) -> float:
        return round(float(rng.uniform(low, high)), 1)

    kind = _KINDS[number % len(_KINDS)]
    strategy = ("weave", "straight", "circle")[int(rng.choice(3, p=[0.5, 0.35, 0.15]))]
    base = load_scene("cylinder")
    assert base.sensor is not None and base.shape is not None
    shape = ObjectSettings(
        kind=kind,  # type: ignore[arg-type]
        position_mm=_PLACE_MM,
        rotation_deg=(0.0, 0.0, within(0, 180)),
        **_RADII[kind](within),  # type: ignore[arg-type]
    )
    task = replace(
        base.task,
        strategy=strategy,  # type: ignore[arg-type]
        force_n=within(1, 3),
        heading_deg=within(0, 360),
        length_mm=within(24, 40),
        width_mm=within(5, 12),
        duration_s=duration_s,
        start_mm=_PLACE_MM,
        clearance_mm=1.0,
    )
    full_scale = float(rng.choice([100.0, 300.0]))
    softer = math.exp(rng.uniform(-0.6, 0.6)) if rng.random() < 0.5 else 1.0
    return replace(
        base,
        scene=replace(base.scene, name=f"random-{number}", seed=100_000 + number, figures=False),
        object=shape,
        task=task,
        sensor=replace(base.sensor, full_scale_kpa=full_scale),
        shape=replace(base.shape, also=()),
        plant=PlantSettings(stiffness_n_m3=LAYER_STIFFNESS * softer),
    )


_Within = Callable[[float, float], float]
_RADII: dict[str, Callable[[_Within], dict[str, float]]] = {
    "plane": lambda _: {},
    "sphere": lambda u: {"radius_mm": u(25, 120)},
    "cylinder": lambda u: {"radius_mm": u(20, 100)},
    "saddle": lambda u: {"radius_x_mm": u(40, 120), "radius_y_mm": -u(65, 150)},
    "ellipsoid": lambda u: {"radius_x_mm": u(40, 90), "radius_y_mm": u(40, 90), "radius_z_mm": u(40, 80)},
    "bowl": lambda u: {"radius_mm": u(70, 150)},
    "torus": lambda u: {"ring_radius_mm": u(70, 130), "radius_mm": u(25, 45)},
    "wave": lambda u: {"amplitude_mm": u(1, 2.5), "wavelength_mm": u(75, 110)},
    "fillet": lambda u: {"radius_mm": u(18, 40), "angle_deg": u(20, 45)},
}
_KINDS = tuple(_RADII)
