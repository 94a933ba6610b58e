"""The PUMA 260 as solid links, from its Denavit–Hartenberg rows: both published geometries, and any like them.

Radii and thicknesses follow photographs of the arm; where the joints are follows the model, so shapes and kinematics
cannot disagree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from canprobe.bridge.transforms import link_transforms
from canprobe.bridge.view.meshes import Array, Mesh, cylinder, dome, link, merged, revolved
from canprobe.robot.puma260 import PumaModel

WHITE, GREY, DARK = (236, 233, 224), (150, 156, 163), (76, 84, 94)
RIM = 5e-3
SHOULDER, ELBOW, WRIST = 0.050, 0.040, 0.026
"""Radii round joints 2, 3 and 5, m."""
UPPER_ARM, FOREARM = 0.046, 0.058
"""Thickness of the two long links along the shoulder's axis, m."""


@dataclass(frozen=True, slots=True)
class Part:
    """One solid of one colour, fixed to a link.

    Attributes:
        name: unique in the arm.
        frame: 0 for the base, i for the frame behind joint i.
        mesh: in that frame, m.
        colour: RGB, 0–255.
    """

    name: str
    frame: int
    mesh: Mesh
    colour: tuple[int, int, int]


def link_frames(model: PumaModel, q: ArrayLike) -> Array:
    """Frames of the base and of every link.

    Args:
        model: the arm.
        q: (6,) joint angles, rad.

    Returns:
        (7, 4, 4) T_base_link; the last is the flange.
    """
    frames = np.empty((7, 4, 4))
    frames[0] = np.eye(4)
    for i, (_, _, T) in enumerate(link_transforms(model, np.asarray(q, dtype=np.float64))):
        frames[i + 1] = frames[i] @ T
    return frames


def arm_parts(model: PumaModel) -> list[Part]:
    """Solids of base and links."""
    return [*_trunk(model), *_upper_arm(model), *_forearm(model), *_wrist(model)]


def _trunk(model: PumaModel) -> list[Part]:
    d1 = model.links[0]
    side = math.copysign(1.0, model.links[2])  # on which side of the trunk the arm hangs, along axis 2
    foot = merged([cylinder(0.092, (0.0, 0.016), 4e-3), cylinder(0.066, (0.016, 0.034), RIM)])
    column = cylinder(0.054, (0.030, d1 - 0.072), RIM)
    # frame 1: z along axis 2, y up along the trunk, origin at the shoulder
    collar = cylinder(0.056, (-0.070, -0.058), 2e-3).moved(_UP)
    neck = cylinder(0.052, (-0.058, 0.0), RIM).moved(_UP)
    drum = cylinder(SHOULDER, _span(-side * 0.062, side * (_reach(model) - 0.002)), RIM)
    return [
        Part("foot", 0, foot, DARK),
        Part("column", 0, column, WHITE),
        Part("collar", 1, collar, DARK),
        Part("shoulder", 1, merged([neck, drum]), WHITE),
    ]


def _reach(model: PumaModel) -> float:
    """From the trunk's axis to the near side of the upper arm, m, along axis 2."""
    return max(abs(model.links[2]) - 0.5 * FOREARM - 0.004 - UPPER_ARM, 0.02)


def _upper_arm(model: PumaModel) -> list[Part]:
    _, a2, offset, _, _, _ = model.links
    side = math.copysign(1.0, offset)
    shift = float(model.dh[2, 2])  # frame 2 lies this far before the plane of the forearm, along axis 2
    trunk = shift - offset
    near, far = trunk + side * _reach(model), trunk + side * (_reach(model) + UPPER_ARM)
    shoulder, elbow = (-a2, 0.0), (0.0, 0.0)
    beam = link((shoulder, SHOULDER + 0.004), (elbow, ELBOW + 0.002), _span(near, far), 8e-3)
    cap = link((shoulder, SHOULDER - 0.014), (shoulder, SHOULDER - 0.014), _span(far, far + side * 0.006), 2e-3)
    pin = cylinder(ELBOW - 0.014, _span(shift, shift - side * (0.5 * FOREARM + 0.02)))
    return [Part("upper_arm", 2, beam, WHITE), Part("shoulder_cap", 2, merged([cap, pin]), DARK)]


def _forearm(model: PumaModel) -> list[Part]:
    _, _, offset, a3, d4, _ = model.links
    # frame 3: z along the forearm, y against axis 2; the elbow is at x = −a3
    half, elbow = 0.5 * FOREARM, (-a3, 0.0)
    side = math.copysign(half, offset)
    beam = link((elbow, ELBOW), ((0.0, d4 - 0.062), WRIST + 0.004), (-half, half), 8e-3)
    cap = link((elbow, ELBOW - 0.014), (elbow, ELBOW - 0.014), _span(side, 1.2 * side), 2e-3)
    ring = cylinder(WRIST - 0.001, (d4 - 0.040, d4 - 0.028), 2e-3)
    return [Part("forearm", 3, beam.moved(_ZX), WHITE), Part("elbow_cap", 3, merged([cap.moved(_ZX), ring]), DARK)]


def _wrist(model: PumaModel) -> list[Part]:
    d6 = model.links[5]
    # frame 4: y along the forearm, z along axis 5; frame 5: z along axis 6
    stem = cylinder(WRIST - 0.003, (-0.030, 0.0), 3e-3).moved(_UP)
    hinge = cylinder(0.021, (-0.027, 0.027), 4e-3)
    hub = link(((0.0, 0.0), 0.018), ((0.0, d6 - 0.024), 0.015), (-0.017, 0.017), 3e-3).moved(_ZX)
    flange = cylinder(0.021, (-0.016, 0.0), 2e-3)
    return [
        Part("wrist", 4, merged([stem, hinge]), WHITE),
        Part("hub", 5, hub, GREY),
        Part("flange", 6, flange, DARK),
    ]


def _span(a: float, b: float) -> tuple[float, float]:
    return (a, b) if a <= b else (b, a)


def probe_parts(radius: float, T_flange_probe: Array) -> tuple[Mesh, Mesh]:
    """The probe in its own frame (origin at the sphere's centre, z the pole): its holder, and its elastic dome.

    Args:
        radius: of the sphere, m.
        T_flange_probe: (4, 4); the holder goes back along z to the flange.
    """
    back = float(T_flange_probe[2, 3])
    r = radius
    outline = [(0.0, -back), (0.014, -back), (0.014, -0.72 * r), (0.62 * r, -0.42 * r), (0.9 * r, -0.42 * r)]
    holder = revolved([*outline, (0.9 * r, -0.34 * r), (0.0, -0.34 * r)])
    return holder, dome(radius, math.radians(110.0))


def _axes(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> Array:
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, y, z])
    return T


_UP = _axes((0, 0, 1), (1, 0, 0), (0, 1, 0))
"""Carries a body along z to one along y."""
_ZX = _axes((1, 0, 0), (0, 0, 1), (0, -1, 0))
"""Carries an outline in x, y to one in x, z."""
