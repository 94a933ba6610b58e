"""Solids of the view: the arm's links, and the probe.

Radii and thicknesses are taken from photographs of the arm, places of the joints from its model, so that shapes and
kinematics agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import ArrayLike

from canprobe.lab.bridge.view.meshes import TriangleMesh, cylinder, dome, link, merged, revolved
from canprobe.mechanics.robot.chain import Chain, link_transforms
from canprobe.mechanics.robot.denavit_hartenberg import dh_step
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation
from canprobe.mechanics.types import Floats

WHITE, GREY, DARK = (236, 233, 224), (150, 156, 163), (76, 84, 94)
RIM_RADIUS_M = 5e-3
SHOULDER, ELBOW, WRIST = 0.050, 0.040, 0.026
"""Radii round joints 2, 3 and 5, m."""
JOINT_RADIUS_M = 0.045
"""Radius round the first joint of any other arm, m."""
UPPER_ARM, FOREARM = 0.046, 0.058
"""Thickness of the two long links along the shoulder's axis, m."""
_TWISTS = 0.5 * math.pi * np.array((1.0, 0.0, -1.0, 1.0, -1.0, 0.0))
"""Angles between the axes of a PUMA, rad."""
_SIZE = (0.2, 0.2)
"""Lengths of upper arm and forearm of the 260, m."""
_EQUAL_M = 1e-9


@dataclass(frozen=True, slots=True)
class Part:
    """One solid of one colour, fixed to a link.

    Attributes:
        name: name, unique in the arm.
        frame: 0 for the base, i for the frame behind joint i.
        mesh: its triangles in that frame, m.
        colour: RGB, 0–255.
        flat: whether its triangles are shaded apart: edges stay sharp without doubled vertices.
    """

    name: str
    frame: int
    mesh: TriangleMesh
    colour: tuple[int, int, int]
    flat: bool = False


def link_frames(chain: Chain, q: ArrayLike) -> Floats:
    """Frames of the base and of every link.

    Args:
        chain: the arm.
        q: joint positions (n,), rad or m.

    Returns:
        Poses T_base_link (n + 1, 4, 4); the last is the flange.
    """
    return np.array([*accumulate(link_transforms(chain, q), np.matmul, initial=np.eye(4))])


def arm_parts(chain: Chain) -> list[Part]:
    """Solids of base and links."""
    puma = _puma(chain)
    return _plain(chain) if puma is None else [*_trunk(puma), *_upper_arm(puma), *_forearm(puma), *_wrist(puma)]


def _plain(chain: Chain) -> list[Part]:
    """A drum along every axis and a bar to the next one, thinner towards the flange."""
    parts = []
    here = chain.fixed[0]  # of a joint in the frame that it stands in
    for i, T in enumerate((*chain.fixed[1:], chain.T_last_flange)):
        radius = JOINT_RADIUS_M * (1.0 - 0.5 * i / chain.n)
        parts.append(Part(f"joint_{i + 1}", i, cylinder(radius, (-radius, radius), RIM_RADIUS_M).moved(here), DARK))
        back = np.linalg.inv(T)[:3, 3]  # the bar stands in the frame of the next joint
        length = float(np.linalg.norm(back))
        if length > radius:
            bar = cylinder(0.7 * radius, (0.0, length), RIM_RADIUS_M)
            turn = homogeneous(tangent_rotation(back / length), (0.0, 0.0, 0.0))
            parts.append(Part(f"link_{i + 1}", i + 1, bar.moved(turn), WHITE))
        here = np.eye(4)
    return parts


@dataclass(frozen=True, slots=True)
class _Puma:
    """Lengths of a PUMA 260, m, by its standard Denavit-Hartenberg rows."""

    d1: float
    a2: float
    d2: float
    d3: float
    a3: float
    d4: float
    d6: float

    @property
    def offset(self) -> float:
        """Distance from the trunk's axis to the forearm, along axis 2."""
        return self.d2 + self.d3


def _puma(chain: Chain) -> _Puma | None:
    """The lengths, where a chain has the axes of a PUMA and the size of the 260; None for any other."""
    steps = (*chain.fixed[1:], chain.T_last_flange)
    if chain.n != _TWISTS.size or any(chain.prismatic):
        return None
    a, d = [float(T[0, 3]) for T in steps], [float(T[2, 3]) for T in steps]
    rows = [dh_step(*row, 0.0) for row in zip(a, _TWISTS, d, strict=True)]
    crossing = max(map(abs, (a[0], *a[3:], d[4]))) < _EQUAL_M
    if not (crossing and np.allclose((np.eye(4), *rows), (chain.fixed[0], *steps), rtol=0.0, atol=_EQUAL_M)):
        return None
    return _Puma(d[0], a[1], d[1], d[2], a[2], d[3], d[5]) if math.dist((a[1], d[3]), _SIZE) < 0.02 else None


def _trunk(puma: _Puma) -> list[Part]:
    side = math.copysign(1.0, puma.offset)  # on which side of the trunk the arm hangs, along axis 2
    foot = merged([cylinder(0.092, (0.0, 0.016), 4e-3), cylinder(0.066, (0.016, 0.034), RIM_RADIUS_M)])
    column = cylinder(0.054, (0.030, puma.d1 - 0.072), RIM_RADIUS_M)
    # frame 1: z along axis 2, y up along the trunk, origin at the shoulder
    collar = cylinder(0.056, (-0.070, -0.058), 2e-3).moved(_UP)
    neck = cylinder(0.052, (-0.058, 0.0), RIM_RADIUS_M).moved(_UP)
    drum = cylinder(SHOULDER, _span(-side * 0.062, side * (_reach(puma) - 0.002)), RIM_RADIUS_M)
    return [
        Part("foot", 0, foot, DARK),
        Part("column", 0, column, WHITE),
        Part("collar", 1, collar, DARK),
        Part("shoulder", 1, merged([neck, drum]), WHITE),
    ]


def _reach(puma: _Puma) -> float:
    """Distance from the trunk's axis to the near side of the upper arm, m, along axis 2."""
    return max(abs(puma.offset) - 0.5 * FOREARM - 0.004 - UPPER_ARM, 0.02)


def _upper_arm(puma: _Puma) -> list[Part]:
    side = math.copysign(1.0, puma.offset)
    shift = puma.d3  # frame 2 lies this far before the plane of the forearm, along axis 2
    trunk = shift - puma.offset
    near, far = trunk + side * _reach(puma), trunk + side * (_reach(puma) + UPPER_ARM)
    shoulder, elbow = (-puma.a2, 0.0), (0.0, 0.0)
    beam = link((shoulder, SHOULDER + 0.004), (elbow, ELBOW + 0.002), _span(near, far), 8e-3)
    cap = link((shoulder, SHOULDER - 0.014), (shoulder, SHOULDER - 0.014), _span(far, far + side * 0.006), 2e-3)
    pin = cylinder(ELBOW - 0.014, _span(shift, shift - side * (0.5 * FOREARM + 0.02)))
    return [Part("upper_arm", 2, beam, WHITE), Part("shoulder_cap", 2, merged([cap, pin]), DARK)]


def _forearm(puma: _Puma) -> list[Part]:
    # frame 3: z along the forearm, y against axis 2; the elbow is at x = −a3
    half, elbow = 0.5 * FOREARM, (-puma.a3, 0.0)
    side = math.copysign(half, puma.offset)
    beam = link((elbow, ELBOW), ((0.0, puma.d4 - 0.062), WRIST + 0.004), (-half, half), 8e-3)
    cap = link((elbow, ELBOW - 0.014), (elbow, ELBOW - 0.014), _span(side, 1.2 * side), 2e-3)
    ring = cylinder(WRIST - 0.001, (puma.d4 - 0.040, puma.d4 - 0.028), 2e-3)
    return [Part("forearm", 3, beam.moved(_ZX), WHITE), Part("elbow_cap", 3, merged([cap.moved(_ZX), ring]), DARK)]


def _wrist(puma: _Puma) -> list[Part]:
    # frame 4: y along the forearm, z along axis 5; frame 5: z along axis 6
    stem = cylinder(WRIST - 0.003, (-0.030, 0.0), 3e-3).moved(_UP)
    hinge = cylinder(0.021, (-0.027, 0.027), 4e-3)
    hub = link(((0.0, 0.0), 0.018), ((0.0, puma.d6 - 0.024), 0.015), (-0.017, 0.017), 3e-3).moved(_ZX)
    flange = cylinder(0.021, (-0.016, 0.0), 2e-3)
    return [
        Part("wrist", 4, merged([stem, hinge]), WHITE),
        Part("hub", 5, hub, GREY),
        Part("flange", 6, flange, DARK),
    ]


def _span(a: float, b: float) -> tuple[float, float]:
    return (a, b) if a <= b else (b, a)


def probe_parts(radius: float, T_flange_probe: Floats) -> tuple[TriangleMesh, TriangleMesh]:
    """The probe in its own frame (origin at the sphere's centre, z the pole): its holder, and its elastic dome.

    Args:
        radius: radius of the sphere, m.
        T_flange_probe: (4, 4); the holder goes back along z to the flange.
    """
    back = float(T_flange_probe[2, 3])
    r = radius
    outline = [(0.0, -back), (0.014, -back), (0.014, -0.72 * r), (0.62 * r, -0.42 * r), (0.9 * r, -0.42 * r)]
    holder = revolved([*outline, (0.9 * r, -0.34 * r), (0.0, -0.34 * r)])
    return holder, dome(radius, math.radians(110.0))


_UP = homogeneous(np.array(((0, 1, 0), (0, 0, 1), (1, 0, 0))), (0.0, 0.0, 0.0))
"""Carries a body along z to one along y."""
_ZX = homogeneous(np.array(((1, 0, 0), (0, 0, -1), (0, 1, 0))), (0.0, 0.0, 0.0))
"""Carries an outline in x, y to one in x, z."""
