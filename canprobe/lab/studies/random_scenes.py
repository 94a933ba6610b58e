"""Random scenes of study `regions`: cell, object, path, force, speed, tool error and array follow from a seed.

The seed of a scene is `draw · 100 000 + kind · 1000 + number`, so that it names its draw and its kind. Arrays come in
three groups. A `shipped` array has the packaged calibration of its make, gains of its own, and in half of the scenes a
layer up to 1.8 × softer or harder than stated. A `calibrated` array has blur, gains, hysteresis, creep, crosstalk, full
scale and layer of its own, and the calibration that touches of this array gave. A `foreign` array is like it, but has
the packaged calibration and another serial number, so that its cell knows it for another one of the make.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from canprobe.cell.plant.taxels import TaxelArray, TaxelConfig
from canprobe.cell.scene.calibrations import dump_calibration, load_calibration
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import ObjectSettings, PlantSettings, Scene
from canprobe.cell.scene.resolve import EMULATED_ARRAY, LAYER_STIFFNESS
from canprobe.errors import UsageError
from canprobe.lab.studies.array_presses import RADIUS_M, Presses, calibrated, pad_of, random_array
from canprobe.lab.studies.drawn_shapes import centred, heights_file, waves_mm

CELLS = {
    "puma260": ((-170.0, -175.0, 300.0), 35.0),
    "puma560": ((-120.0, -122.5, 374.0), 35.0),
    "seven-axis": ((-120.0, -122.5, 374.0), 35.0),
    "prbt": ((-120.0, -122.5, 374.0), 35.0),
    "gantry": ((-120.0, -122.5, 374.0), 11.0),
}
"""Cell → place that its arm touches (mm), and angle (deg) that the normal may turn along a path: a gantry keeps the
orientation of the probe, so that the contact runs over the pad."""
FOREIGN = "foreign"
"""Kind of the scenes whose array has a foreign calibration; their objects are of all other kinds by turns."""
PATH_MM, SHORTEST_S, LONGEST_S = 100.0, 4.0, 12.0
"""Way of a scan, and the least and most time for it."""
SPEEDS_MM_S, FORCES_N = (3.0, 100.0), (0.2, 10.0)
"""Least and greatest speed and force of a scan, with an equal share of each octave."""
TOOL_ERROR_MM = 0.4
"""Largest error of the centre of the probe along an axis, in half of the scenes."""
MOST_CURVED_PER_M = 15.0
"""Largest curvature of a hollow of a wave or of heights: two thirds of what the probe fits into."""


class SceneSeed(NamedTuple):
    """The parts of a scene's seed."""

    draw: int
    kind: str
    number: int

    @classmethod
    def of(cls, seed: int) -> SceneSeed:
        """The parts of a seed.

        Raises:
            UsageError: no scene has this seed.
        """
        kind = seed // 1000 % 100
        if kind >= len(KINDS):
            raise UsageError(
                f"seed {seed}: expected draw · 100000 + kind · 1000 + number with a kind up to {len(KINDS) - 1}, got"
                f" kind {kind}; `canprobe study regions` prints the seeds of a draw"
            )
        return cls(seed // 100_000, KINDS[kind], seed % 1000)

    def value(self) -> int:
        """The seed."""
        return self.draw * 100_000 + KINDS.index(self.kind) * 1000 + self.number


class DrawnScene(NamedTuple):
    """A scene whose emulated array may be another than its keys describe.

    Attributes:
        scene: the scene.
        kind: kind of the object.
        group: group of the array: "shipped", "calibrated" or "foreign".
        array: the emulated array; None: that of the scene.
    """

    scene: Scene
    kind: str
    group: str
    array: TaxelArray | None


def own_array(seed: int) -> tuple[TaxelConfig, float, np.random.Generator]:
    """A random array, the stiffness of its layer (N/m³), and the generator of its gains and noise."""
    config, stiffness, rng = random_array(seed)
    return replace(config, gain_error=rng.uniform(0.02, 0.08)), stiffness, rng


def _emulated(seed: int) -> TaxelArray:
    """The random array as its calibration touches it, with noise of its own."""
    config, stiffness, gains = own_array(seed)
    arrays = [
        TaxelArray(config, rng, radius_m=RADIUS_M, stiffness_n_m3=stiffness, pad=pad_of(config))
        for rng in (gains, np.random.default_rng([39, seed]))
    ]
    arrays[1].take_gains(arrays[0])
    return arrays[1]


def random_scene(seed: int, folder: Path) -> DrawnScene:
    """The random scene of a seed.

    Args:
        seed: its seed.
        folder: folder for the files of the scene: calibration and heights.

    Raises:
        UsageError: no scene has this seed.
    """
    _, kind, number = SceneSeed.of(seed)
    rng = np.random.default_rng([38, seed])
    group = "calibrated" if number % 3 else "shipped"
    if kind == FOREIGN:
        group, kind = FOREIGN, KINDS[number % (len(KINDS) - 1)]
    cell = str(rng.choice(list(CELLS)))
    place, tilt_deg = CELLS[cell]
    base = load_scene("cylinder", {"cell": cell})
    assert base.sensor is not None and base.shape is not None
    keys = _OBJECTS[kind](rng)
    if "heights" in keys:
        keys |= heights_file(folder, keys.pop("heights"))
    strategy = str(rng.choice(["weave", "straight", "circle"], p=[0.5, 0.3, 0.2]))
    sides = 1.0 if strategy == "circle" else 2.0  # a circle begins at the touch, other paths lead to both sides of it
    longest = max(8.0, min(40.0, sides * keys.pop("sharpest_mm") * math.sin(math.radians(tilt_deg))))
    speed, force = _spread(rng, *SPEEDS_MM_S), _spread(rng, *FORCES_N)
    task = replace(
        base.task,
        strategy=strategy,  # type: ignore[arg-type]
        force_n=force,
        speed_mm_s=speed,
        heading_deg=_within(rng, 0.0, 360.0),
        length_mm=_within(rng, 0.6 * longest, longest),
        width_mm=_within(rng, 0.15 * longest, 0.3 * longest),
        wavelength_mm=_within(rng, 8.0, 16.0),
        duration_s=round(min(max(PATH_MM / speed, SHORTEST_S), LONGEST_S), 1),
        start_mm=place,
        clearance_mm=1.0,
    )
    most = TOOL_ERROR_MM if rng.random() < 0.5 else 0.0
    x, y, z = (_within(rng, -most, most) for _ in range(3))
    softer = math.exp(rng.uniform(-0.6, 0.6)) if rng.random() < 0.5 else 1.0
    sensor = replace(base.sensor, full_scale_kpa=float(rng.choice([100.0, 300.0])))
    stiffness, array = LAYER_STIFFNESS * softer, None
    if group != "shipped":
        config, stiffness, _ = own_array(seed)
        array, sensor = _emulated(seed), replace(sensor, full_scale_kpa=1e-3 * config.full_scale_pa)
        calibration, serial = load_calibration(EMULATED_ARRAY), 2
        if group == "calibrated":
            calibration, serial = calibrated(Presses(*own_array(seed)), f"emulated, seed {seed}").calibration, 1
        file = folder / "calibration.toml"
        file.write_text(dump_calibration(replace(calibration, serial_number=1)), encoding="utf-8")
        sensor = replace(sensor, calibration=str(file), serial_number=serial)
    scene = replace(
        base,
        scene=replace(base.scene, name=f"random-{seed}", seed=seed),
        outputs=replace(base.outputs, figures=False),
        bus=replace(base.bus, interface="direct"),
        object=ObjectSettings(position_mm=place, rotation_deg=(0.0, 0.0, _within(rng, 0.0, 180.0)), **keys),
        task=task,
        limits=replace(base.limits, force_max_n=max(base.limits.force_max_n, 1.5 * force)),
        sensor=sensor,
        shape=replace(base.shape, also=()),
        plant=PlantSettings(stiffness_n_m3=stiffness, tool_error_mm=(x, y, z)),
    )
    return DrawnScene(scene, kind, group, array)


def _within(rng: np.random.Generator, low: float, high: float) -> float:
    return round(float(rng.uniform(low, high)), 1)


def _spread(rng: np.random.Generator, low: float, high: float) -> float:
    """A length or speed with an equal share of each octave."""
    return round(math.exp(rng.uniform(math.log(low), math.log(high))), 1)


def _ellipsoid(rng: np.random.Generator) -> dict[str, Any]:
    """An ellipsoid of two radii on its crown; its semi-axes follow from them and its height."""
    radii, height = [_spread(rng, 12, 120) for _ in range(2)], _within(rng, 25, 80)
    x, y = (round(math.sqrt(radius * height), 1) for radius in radii)
    return {
        "kind": "ellipsoid", "radius_x_mm": x, "radius_y_mm": y, "radius_z_mm": height,
        "sharpest_mm": min(*radii, 0.7 * x, 0.7 * y),
    }  # fmt: skip


def _saddle(rng: np.random.Generator) -> dict[str, Any]:
    x, y = _spread(rng, 12, 120), _within(rng, 60, 150)
    return {"kind": "saddle", "radius_x_mm": x, "radius_y_mm": -y, "sharpest_mm": min(x, y)}


def _torus(rng: np.random.Generator) -> dict[str, Any]:
    tube = _spread(rng, 12, 45)
    return {"kind": "torus", "ring_radius_mm": tube + _within(rng, 25, 90), "radius_mm": tube, "sharpest_mm": tube}


def _wave(rng: np.random.Generator) -> dict[str, Any]:
    wavelength, curved = _spread(rng, 40, 110), rng.uniform(4.0, MOST_CURVED_PER_M)
    amplitude = round(1e-3 * curved * (wavelength / (2.0 * math.pi)) ** 2, 2)
    return {"kind": "wave", "amplitude_mm": amplitude, "wavelength_mm": wavelength, "sharpest_mm": 1e3 / curved}


def _fillet(rng: np.random.Generator) -> dict[str, Any]:
    """A fillet; the path leads over it to both of its planes, so its angle bounds how far the normal turns."""
    return {"kind": "fillet", "radius_mm": _spread(rng, 12, 40), "angle_deg": _within(rng, 15, 45), "sharpest_mm": 60.0}


def _heights(rng: np.random.Generator, shortest_mm: float, longest_mm: float) -> dict[str, Any]:
    """A dome of radius 90 mm with six waves of any direction, whose lengths have bounds."""
    x, y, waves = waves_mm(rng, shortest_mm, longest_mm)
    # the six curvatures add up to their largest value nearly nowhere
    heights = 1e-3 * MOST_CURVED_PER_M / 3.0 * waves - (x**2 + y**2) / (2.0 * 90.0)
    return {"heights": centred(heights), "sharpest_mm": 60.0}


_OBJECTS: dict[str, Callable[[np.random.Generator], dict[str, Any]]] = {
    "plane": lambda _: {"kind": "plane", "sharpest_mm": math.inf},
    "sphere": lambda rng: {"kind": "sphere", "radius_mm": (r := _spread(rng, 12, 120)), "sharpest_mm": r},
    "cylinder": lambda rng: {"kind": "cylinder", "radius_mm": (r := _spread(rng, 12, 100)), "sharpest_mm": r},
    "ellipsoid": _ellipsoid,
    "saddle": _saddle,
    "bowl": lambda rng: {"kind": "bowl", "radius_mm": (r := _within(rng, 60, 150)), "sharpest_mm": r},
    "torus": _torus,
    "wave": _wave,
    "fillet": _fillet,
    "heights": lambda rng: _heights(rng, 36.0, 80.0),
    "rough": lambda rng: _heights(rng, 12.0, 36.0),
}
"""Kind → function that draws its keys of `[object]`, and the smallest radius of curvature, which bounds its path."""
KINDS = (*_OBJECTS, FOREIGN)
"""Kinds of scenes, in the order of their seeds."""
