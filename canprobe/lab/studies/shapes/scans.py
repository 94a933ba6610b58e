"""The shapes of the benchmark, their scans through the whole emulated sensor.

A scan is a weave of 32 by 14 mm at 25 mm/s and 2 N on the direct bus, with everything that an array does to a touch;
shape, pose, path and array (its seed) are fixed. No seed here was used in a calibration or to look at an estimator.

The file holds, for each shape, the contacts as the estimators take them with their stated noise, and the truth under
the path: points of the true surface on a grid, with normals and curvature. Methods and scores read nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from canprobe.cell.planning.make import make_plan
from canprobe.cell.results.scores import curvature_tensor
from canprobe.cell.scene.geometry import true_object
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import ObjectSettings, PlantSettings, Scene
from canprobe.cell.scene.resolve import LAYER_STIFFNESS, resolve
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import PlanError
from canprobe.lab.studies.harness import Say
from canprobe.mechanics.touch.contact import ContactSample, Doubt, Slope
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.types import Floats

FORMS: Mapping[str, Mapping[str, Any]] = {
    # development: for settings of methods
    "ball-45": {"kind": "sphere", "radius_mm": 45},
    "rod-38": {"kind": "cylinder", "radius_mm": 38},
    "egg-70": {"kind": "ellipsoid", "radius_x_mm": 70, "radius_y_mm": 50, "radius_z_mm": 55},
    "saddle-60": {"kind": "saddle", "radius_x_mm": 60, "radius_y_mm": -110},
    "wave-90": {"kind": "wave", "amplitude_mm": 1.5, "wavelength_mm": 90},
    "fillet-22": {"kind": "fillet", "radius_mm": 22, "angle_deg": 35},
    "free-1": {"kind": "heights", "made": ("free", 1)},
    "groove-1": {"kind": "heights", "made": ("groove", 2)},
    # test
    "ball-70": {"kind": "sphere", "radius_mm": 70},
    "rod-45": {"kind": "cylinder", "radius_mm": 45},
    "egg-55": {"kind": "ellipsoid", "radius_x_mm": 55, "radius_y_mm": 80, "radius_z_mm": 60},
    "saddle-90": {"kind": "saddle", "radius_x_mm": 90, "radius_y_mm": -75},
    "torus": {"kind": "torus", "ring_radius_mm": 100, "radius_mm": 32},
    "bowl": {"kind": "bowl", "radius_mm": 95},
    "wave-85": {"kind": "wave", "amplitude_mm": 2.2, "wavelength_mm": 85},
    "fillet-25": {"kind": "fillet", "radius_mm": 25, "angle_deg": 40},
    "free-2": {"kind": "heights", "made": ("free", 3)},
    "free-3": {"kind": "heights", "made": ("fine", 4)},
    "groove-2": {"kind": "heights", "made": ("groove", 5)},
    "edge": {"kind": "heights", "made": ("edge", 6)},
}
"""Shape → keys of `[object]`; heights are `made` by a form and a seed."""
DRAWN_SHAPES = 12
"""Number of shapes that a draw has, one of each kind of the test shapes."""
DEVELOPMENT, TEST = tuple(FORMS)[:8], tuple(FORMS)[8:]
FIRST_SEED = 260_000
_PLACE_MM = (-170.0, -175.0, 300.0)
"""Place where the arm reaches in all directions, mm."""
LENGTH_MM, WIDTH_MM, WEAVE_MM, SECONDS = 32.0, 14.0, 9.0, 10.0
FOOTPRINT_M, MARGIN_M, GRID_M = 3e-3, 5e-3, 0.5e-3
"""Truth counts as far from the contacts as the pad presses on it; it is kept farther, for what a map adds; its grid."""
EDGE_PER_M = 20.0
"""Change of curvature within the footprint's radius beyond which a point is near an edge."""
SPACING_MM = 0.5


def drawn(draw: int) -> tuple[str, ...]:
    """Names of shapes that nobody has seen before: sizes, forms, arrays and seeds follow from the number of a draw."""
    return tuple(f"drawn-{draw}-{kind}" for kind in range(DRAWN_SHAPES))


def form_of(name: str) -> dict[str, Any]:
    """Keys of `[object]` of a shape by its name; those of a draw are within the range of the other shapes."""
    if name in FORMS:
        return dict(FORMS[name])
    draw, kind = (int(part) for part in name.split("-")[1:])
    rng = np.random.default_rng([262, draw, kind])

    def mm(low: float, high: float) -> float:
        return round(float(rng.uniform(low, high)), 2)

    made = int(rng.integers(1 << 30))
    forms: list[dict[str, Any]] = [
        {"kind": "sphere", "radius_mm": mm(40, 80)},
        {"kind": "cylinder", "radius_mm": mm(36, 60)},
        {"kind": "ellipsoid", "radius_x_mm": mm(50, 80), "radius_y_mm": mm(50, 80), "radius_z_mm": mm(50, 65)},
        {"kind": "saddle", "radius_x_mm": mm(60, 100), "radius_y_mm": -mm(75, 120)},
        {"kind": "torus", "ring_radius_mm": mm(90, 120), "radius_mm": mm(30, 45)},
        {"kind": "bowl", "radius_mm": mm(90, 130)},
        {"kind": "wave", "amplitude_mm": mm(1.5, 2.2), "wavelength_mm": mm(85, 95)},
        {"kind": "fillet", "radius_mm": mm(22, 28), "angle_deg": mm(32, 40)},
        *({"kind": "heights", "made": (form, made)} for form in ("free", "fine", "groove", "edge")),
    ]
    return forms[kind]


def number_of(name: str) -> int:
    """Number of a shape, which its seeds follow from."""
    if name in FORMS:
        return list(FORMS).index(name)
    draw, kind = (int(part) for part in name.split("-")[1:])
    return 1000 + DRAWN_SHAPES * draw + kind


def heights_mm(form: str, seed: int) -> Floats:
    """Heights over 64 by 64 mm, mm: free forms of waves, some with a groove or an edge."""
    rng = np.random.default_rng([26, seed])
    side = np.arange(-32, 32.1, SPACING_MM)
    x, y = np.meshgrid(side, side, indexing="ij")
    long, short = (40.0, 26.0) if form == "fine" else (70.0, 40.0)
    z = np.zeros_like(x)
    for wavelength, heading, phase in rng.uniform((short, 0.0, 0.0), (long, 2 * np.pi, 2 * np.pi), (6, 3)):
        k = 2 * np.pi / wavelength
        z += np.cos(k * (np.cos(heading) * x + np.sin(heading) * y) + phase) / k**2  # 1 per mm of curvature
    z *= 0.006 if form in ("free", "fine") else 0.002
    z -= (x**2 + y**2) / (2 * 90)
    if form == "groove":  # 2 mm wide, 0.4 mm deep, oblique
        z -= 0.4 * np.exp(-(((x - 0.3 * y - rng.uniform(-4, 4)) / 1.0) ** 4))
    if form == "edge":  # the surface falls off by another 10 degrees
        over = 0.96 * (x - rng.uniform(-3, 3)) + 0.28 * y
        z -= np.tan(np.radians(10.0)) * 0.5 * (over + np.hypot(over, 0.5))
    heights: Floats = z - z[len(side) // 2, len(side) // 2]
    return heights


def object_of(name: str, folder: Path) -> ObjectSettings:
    """`[object]` of a shape; its heights are written into a folder."""
    keys = form_of(name)
    if "made" in keys:
        keys["file"] = str(folder / f"{name}.npz")
        np.savez(keys["file"], heights=heights_mm(*keys.pop("made")), spacing=SPACING_MM)
    turn = 37.0 * number_of(name) % 180
    return ObjectSettings(position_mm=_PLACE_MM, rotation_deg=(0.0, 0.0, turn), **keys)


def scene_of(name: str, folder: Path, seconds: float = SECONDS) -> Scene:
    """The scene of a shape: one array, and one layer in two not of the stated stiffness, of its own."""
    number = number_of(name)
    rng = np.random.default_rng([261, number])
    base = load_scene("cylinder")
    assert base.shape is not None
    task = replace(
        base.task, duration_s=seconds, start_mm=_PLACE_MM, clearance_mm=1.0, heading_deg=float(rng.integers(0, 360)),
        length_mm=LENGTH_MM, width_mm=WIDTH_MM, wavelength_mm=WEAVE_MM,
    )  # fmt: skip
    softer = float(np.exp(rng.uniform(-0.4, 0.4))) if number % 2 else 1.0
    return replace(
        base,
        scene=replace(base.scene, name=name, seed=FIRST_SEED + number, figures=False),
        bus=replace(base.bus, interface="direct"),
        object=object_of(name, folder),
        task=task,
        shape=replace(base.shape, also=()),
        plant=PlantSettings(stiffness_n_m3=LAYER_STIFFNESS * softer),
    )


def reached(names: Sequence[str], say: Say) -> tuple[str, ...]:
    """The shapes whose weave the arm reaches; the others, 2 of the 408 of draws 1 to 34, are said and left out."""
    found = []
    for name in names:
        with TemporaryDirectory() as folder:
            try:
                make_plan(resolve(scene_of(name, Path(folder))))
            except PlanError as error:
                say(f"{name} is left out: {str(error).splitlines()[0]}")
            else:
                found.append(name)
    return tuple(found)


class ScanCase(NamedTuple):
    """One scan."""

    shape: str
    seconds: float


def scan(case: ScanCase) -> dict[str, Floats]:
    """Columns of the file for one shape."""
    with TemporaryDirectory() as folder:
        scene = scene_of(case.shape, Path(folder), case.seconds)
        task: Any = make_task(make_plan(resolve(scene)))
        with Session(scene) as session:
            session.run(task)
        assert scene.object is not None
        columns = columns_of(task.shape.samples)
        return columns | truth_under(true_object(scene.object), columns["p_base"])


def columns_of(samples: Sequence[ContactSample]) -> dict[str, Floats]:
    """Contacts as columns, a row each; NaN where one has no such value."""

    def number(value: float | None) -> float:
        return np.nan if value is None else value

    return {
        "t_s": np.array([s.t_s for s in samples]),
        "p_base": np.array([s.p_base for s in samples]),
        "n_base": np.array([s.n_base for s in samples]),
        "T_base_probe": np.array([s.T_base_probe[:3].ravel() for s in samples]),
        "r_probe": np.array([s.r_probe for s in samples]),
        "force_n": np.array([s.force_n for s in samples]),
        "sigma": np.array(
            [
                [number(s.sigma_point), number(s.sigma_normal), s.sigma_motion, number(s.sigma_height), s.sigma_slow]
                for s in samples
            ]
        ),
        "moments": np.array([s.moments or (np.nan,) * 3 for s in samples]),
        "slope": np.array([s.slope or (np.nan,) * 2 for s in samples]),
        "doubts": np.array([sum(1 << _DOUBTS.index(d) for d in s.doubts) for s in samples], float),
    }


_DOUBTS = tuple(Doubt)


def samples_of(columns: Mapping[str, Floats]) -> list[ContactSample]:
    """The contacts of `columns_of`."""

    def value(number: float) -> float | None:
        return None if np.isnan(number) else float(number)

    found = []
    for i, t in enumerate(columns["t_s"].tolist()):
        T = np.eye(4)
        T[:3] = columns["T_base_probe"][i].reshape(3, 4)
        moments, slope, sigma = columns["moments"][i], columns["slope"][i], columns["sigma"][i]
        uu, uv, vv = moments.tolist()
        doubts = tuple(d for k, d in enumerate(_DOUBTS) if int(columns["doubts"][i]) >> k & 1)
        found.append(
            ContactSample(
                t, columns["p_base"][i], columns["n_base"][i], T, columns["r_probe"][i], float(columns["force_n"][i]),
                value(sigma[0]), value(sigma[1]), None if np.isnan(uu) else (uu, uv, vv), doubts, float(sigma[2]),
                None if np.isnan(slope[0]) else Slope(*slope.tolist()), value(sigma[3]), float(sigma[4]),
            )
        )  # fmt: skip
    return found


def truth_under(shape: PlacedShape, contacts: Floats) -> dict[str, Floats]:
    """The true surface under contacts (n, 3): points, normals, curvature tensors, and which count, on a grid."""
    feet = np.array([shape.nearest(tuple(p)).point for p in contacts[::4].tolist()])
    up = shape.T_base_object[:3, :3]
    flat = (feet - shape.T_base_object[:3, 3]) @ up
    low, high = flat.min(axis=0) - MARGIN_M, flat.max(axis=0) + MARGIN_M
    sides = (np.arange(low[k], high[k], GRID_M) for k in (0, 1))
    grid = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)
    apart, nearest = cKDTree(flat[:, :2]).query(grid)
    near = apart < MARGIN_M
    above = np.column_stack([grid, flat[nearest, 2]])[near] @ up.T + shape.T_base_object[:3, 3]
    found = [shape.closest(p) for p in above]
    points = np.array([one.point for one in found])
    tensors = np.array([curvature_tensor(one.kappa, *one.directions) for one in found])
    away = cKDTree(feet).query(points)[0]
    tree = cKDTree(points)
    edge = np.zeros(len(points), bool)
    for i, beside in enumerate(tree.query_ball_point(points, FOOTPRINT_M)):
        edge[i] = np.linalg.norm(tensors[beside] - tensors[i], axis=(1, 2)).max() > EDGE_PER_M
    return {
        "truth_point": points,
        "truth_normal": np.array([one.normal for one in found]),
        "truth_tensor": tensors.reshape(-1, 9),
        "truth_counts": np.less(away, FOOTPRINT_M).astype(float),
        "truth_edge": edge.astype(float),
    }
