"""Shapes of study `surfaces`, drawn at random: twelve in a draw, formulae and heights with grooves and edges.

Size, form, pose, array and seed of a shape follow from its draw and its kind. Its true surface is known at points of a
rectangle (`TrueGround`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from canprobe.cell.results.scores import curvature_tensor
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import LAYER_STIFFNESS
from canprobe.cell.scene.setup import Approach
from canprobe.lab.studies.surface_methods import FoundSurface
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.types import Floats

KINDS = (
    "sphere", "cylinder", "ellipsoid", "saddle", "torus", "bowl", "wave", "fillet", "free", "fine", "groove", "edge",
)  # fmt: skip
"""Kinds of shapes; the last four are heights."""
PLACE_MM = (-170.0, -175.0, 300.0)
"""Place where the arm reaches in all directions, mm."""
FIRST_SEED = 261_000
LENGTH_MM, WIDTH_MM = 30.0, 20.0
"""Sides of the rectangle that is touched."""
TARGET_UM = 15.0
"""Standard deviation of the height at which an exploration ends, µm."""
TRUTH_M = 1.5e-3
"""Spacing of the true surface's points, m."""
WORST_ERRORS = (1e-3, 0.1, 20.0)
"""Largest errors that count, also of ground that a surface does not have: height (m), normal (rad), curvature (1/m)."""
SPACING_MM, SIDE_MM = 0.5, 64.0
"""Spacing and side of a grid of heights."""


class DrawnShape(NamedTuple):
    """A shape by its draw and the number of its kind."""

    draw: int
    kind: int

    @property
    def name(self) -> str:
        """Name of its kind."""
        return KINDS[self.kind]

    @property
    def number(self) -> int:
        """Number that its seeds follow from."""
        return len(KINDS) * self.draw + self.kind


def drawn(draw: int) -> tuple[DrawnShape, ...]:
    """The shapes of a draw."""
    return tuple(DrawnShape(draw, kind) for kind in range(len(KINDS)))


def scene_of(shape: DrawnShape, folder: Path, seconds: float) -> Scene:
    """An exploration of a shape, with an array of its own; one layer in two is not of the stated stiffness.

    Args:
        shape: the shape.
        folder: folder for its heights.
        seconds: duration of the scan.
    """
    rng = np.random.default_rng([261, 1000 + shape.number])
    heading = float(rng.integers(0, 360))
    softer = float(np.exp(rng.uniform(-0.4, 0.4))) if shape.number % 2 else 1.0
    return load_scene("cylinder", {
        "scene.name": shape.name, "scene.seed": FIRST_SEED + shape.number, "outputs.figures": False,
        "bus.interface": "direct", "object": object_of(shape, folder), "shape.also": (),
        "task.strategy": "explore", "task.length_mm": LENGTH_MM, "task.width_mm": WIDTH_MM,
        "task.target_sigma_um": TARGET_UM, "task.duration_s": seconds, "task.start_mm": PLACE_MM,
        "task.clearance_mm": 1.0, "task.heading_deg": heading, "plant": {"stiffness_n_m3": LAYER_STIFFNESS * softer},
    })  # fmt: skip


def object_of(shape: DrawnShape, folder: Path) -> dict[str, Any]:
    """`[object]` of a shape; its heights are written into a folder."""
    rng = np.random.default_rng([262, *shape])

    def mm(low: float, high: float) -> float:
        return round(float(rng.uniform(low, high)), 2)

    seed = int(rng.integers(1 << 30))
    forms: list[dict[str, Any]] = [
        {"kind": "sphere", "radius_mm": mm(40, 80)},
        {"kind": "cylinder", "radius_mm": mm(36, 60)},
        {"kind": "ellipsoid", "radius_x_mm": mm(50, 80), "radius_y_mm": mm(50, 80), "radius_z_mm": mm(50, 65)},
        {"kind": "saddle", "radius_x_mm": mm(60, 100), "radius_y_mm": -mm(75, 120)},
        {"kind": "torus", "ring_radius_mm": mm(90, 120), "radius_mm": mm(30, 45)},
        {"kind": "bowl", "radius_mm": mm(90, 130)},
        {"kind": "wave", "amplitude_mm": mm(1.5, 2.2), "wavelength_mm": mm(85, 95)},
        {"kind": "fillet", "radius_mm": mm(22, 28), "angle_deg": mm(32, 40)},
    ]
    formula = shape.kind < len(forms)
    keys = forms[shape.kind] if formula else heights_file(folder, form_heights_mm(shape.name, seed))
    turn = 37.0 * (1000 + shape.number) % 180
    return {"position_mm": PLACE_MM, "rotation_deg": (0.0, 0.0, turn), **keys}


def form_heights_mm(form: str, seed: int) -> Floats:
    """Heights (n, n) of a free form, of a finer one, or of one with a groove or an edge, mm."""
    rng = np.random.default_rng([26, seed])
    x, y, waves = waves_mm(rng, *((26.0, 40.0) if form == "fine" else (40.0, 70.0)))
    z = (6e-3 if form in ("free", "fine") else 2e-3) * waves - (x**2 + y**2) / (2 * 90)
    if form == "groove":  # 2 mm wide, 0.4 mm deep, oblique
        z -= 0.4 * np.exp(-(((x - 0.3 * y - rng.uniform(-4, 4)) / 1.0) ** 4))
    if form == "edge":  # the surface falls off by another 10 degrees
        over = 0.96 * (x - rng.uniform(-3, 3)) + 0.28 * y
        z -= np.tan(np.radians(10.0)) * 0.5 * (over + np.hypot(over, 0.5))
    return centred(z)


def waves_mm(rng: np.random.Generator, shortest_mm: float, longest_mm: float) -> tuple[Floats, Floats, Floats]:
    """Places x, y and heights (n, n) of six waves of any direction, mm, each with a curvature of 1 per mm.

    Args:
        rng: generator of lengths, directions and phases.
        shortest_mm, longest_mm: bounds of the wavelengths.
    """
    side = np.arange(-SIDE_MM / 2, SIDE_MM / 2 + 0.1, SPACING_MM)
    x, y = np.meshgrid(side, side, indexing="ij")
    z = np.zeros_like(x)
    for wavelength, heading, phase in rng.uniform(
        (shortest_mm, 0.0, 0.0), (longest_mm, 2 * np.pi, 2 * np.pi), (6, 3)
    ).tolist():
        k = 2.0 * np.pi / wavelength
        z += np.cos(k * (np.cos(heading) * x + np.sin(heading) * y) + phase) / k**2
    return x, y, z


def centred(z: Floats) -> Floats:
    """Heights with 0 in the middle."""
    heights: Floats = z - z[len(z) // 2, len(z) // 2]
    return heights


def heights_file(folder: Path, heights: Floats) -> dict[str, Any]:
    """Keys of `[object]` of heights (n, n), mm, which are written into a folder."""
    file = folder / "heights.npz"
    np.savez(file, heights=heights, spacing=SPACING_MM)
    return {"kind": "heights", "file": str(file)}


class TrueGround(NamedTuple):
    """The true surface of the rectangle: points (n, 3), m, normals (n, 3), curvature tensors (n, 3, 3), 1/m."""

    points: Floats
    normals: Floats
    tensors: Floats

    @classmethod
    def of(cls, shape: PlacedShape, approach: Approach, middle: Floats) -> TrueGround:
        """The surface of an object under the rectangle of an approach's plane round a place (3,), m."""
        sides = (1e-3 * LENGTH_MM, 1e-3 * WIDTH_MM)
        x, y = (np.arange(-0.5 * side + 0.5 * TRUTH_M, 0.5 * side, TRUTH_M) for side in sides)
        flat = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        feet = []
        for place in middle + flat @ approach.axes[:2]:
            height = 0.0
            for _ in range(20):  # Newton, along the approach
                foot = shape.closest(place + height * approach.normal)
                height -= foot.distance / max(float(foot.normal @ approach.normal), 0.3)
            feet.append(foot)
        return cls(
            np.array([foot.point for foot in feet]),
            np.array([foot.normal for foot in feet]),
            np.array([curvature_tensor(foot.kappa, *foot.directions) for foot in feet]),
        )

    def errors(self, found: FoundSurface) -> tuple[Floats, ...]:
        """Errors (n,) of height, normal and curvature; what a surface does not have counts as `WORST_ERRORS`."""
        away = np.abs(found.height)
        turned = np.linalg.norm(np.cross(found.normal, self.normals), axis=1)
        bent = np.linalg.norm(found.tensor - self.tensors, axis=(1, 2))
        return tuple(
            np.minimum(np.where(np.isfinite(e), e, most), most)
            for e, most in zip((away, turned, bent), WORST_ERRORS, strict=True)
        )
