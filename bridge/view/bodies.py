"""What is seen as solid: the arm's links, the touched object, the estimated patch, the tactile array.

Radii and thicknesses follow photographs of the arm; where the joints are follows the model, so shapes and kinematics
cannot disagree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from canprobe.lab.bridge.sample import link_transforms
from canprobe.lab.bridge.view.meshes import (
    MAGMA,
    Array,
    Colours,
    Mesh,
    cylinder,
    dome,
    grid,
    link,
    merged,
    revolved,
    scale,
)
from canprobe.mechanics.robot.chain import Chain, dh_step
from canprobe.mechanics.touch.contact import pad_to_direction
from canprobe.mechanics.touch.heights import Heights
from canprobe.mechanics.touch.linear_algebra import tangent_rotation
from canprobe.mechanics.touch.objects import Cylinder, Sphere
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.touch.shapes import Bowl, PlacedShape, Torus, Wave

# The PUMA 260 as solid links, by the lengths of its chain; any other arm as plain joints and bars.

WHITE, GREY, DARK = (236, 233, 224), (150, 156, 163), (76, 84, 94)
RIM = 5e-3
SHOULDER, ELBOW, WRIST = 0.050, 0.040, 0.026
"""Radii round joints 2, 3 and 5, m."""
PLAIN = 0.045
"""Radius round the first joint of any other arm, m."""
UPPER_ARM, FOREARM = 0.046, 0.058
"""Thickness of the two long links along the shoulder's axis, m."""
_TWISTS = 0.5 * math.pi * np.array((1.0, 0.0, -1.0, 1.0, -1.0, 0.0))
"""Between the axes of a PUMA, rad."""
_SIZE = (0.2, 0.2)
"""Upper arm and forearm of the 260, m."""
_SAME = 1e-9


@dataclass(frozen=True, slots=True)
class Part:
    """One solid of one colour, fixed to a link.

    Attributes:
        name: unique in the arm.
        frame: 0 for the base, i for the frame behind joint i.
        mesh: in that frame, m.
        colour: RGB, 0–255.
        flat: its triangles are shaded apart: edges stay sharp without doubled vertices.
    """

    name: str
    frame: int
    mesh: Mesh
    colour: tuple[int, int, int]
    flat: bool = False


def link_frames(chain: Chain, q: ArrayLike) -> Array:
    """Frames of the base and of every link.

    Args:
        chain: the arm.
        q: (n,) joint positions, rad or m.

    Returns:
        (n + 1, 4, 4) T_base_link; the last is the flange.
    """
    frames = np.empty((chain.n + 1, 4, 4))
    frames[0] = np.eye(4)
    for i, (_, _, T) in enumerate(link_transforms(chain, np.asarray(q, dtype=np.float64))):
        frames[i + 1] = frames[i] @ T
    return frames


def arm_parts(chain: Chain) -> list[Part]:
    """Solids of base and links."""
    puma = _puma(chain)
    return _plain(chain) if puma is None else [*_trunk(puma), *_upper_arm(puma), *_forearm(puma), *_wrist(puma)]


def _plain(chain: Chain) -> list[Part]:
    """A drum along every axis and a bar to the next one, thinner towards the flange."""
    parts = []
    here = chain.fixed[0]  # of a joint in the frame that it stands in
    for i, T in enumerate((*chain.fixed[1:], chain.T_last_flange)):
        radius = PLAIN * (1.0 - 0.5 * i / chain.n)
        parts.append(Part(f"joint_{i + 1}", i, cylinder(radius, (-radius, radius), RIM).moved(here), DARK))
        back = np.linalg.inv(T)[:3, 3]  # the bar stands in the frame of the next joint
        length = float(np.linalg.norm(back))
        if length > radius:
            bar = np.eye(4)
            bar[:3, :3] = tangent_rotation(back / length)
            parts.append(Part(f"link_{i + 1}", i + 1, cylinder(0.7 * radius, (0.0, length), RIM).moved(bar), WHITE))
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
        """From the trunk's axis to the forearm, along axis 2."""
        return self.d2 + self.d3


def _puma(chain: Chain) -> _Puma | None:
    """The lengths, where a chain has the axes of a PUMA and the size of the 260; None of any other."""
    steps = (*chain.fixed[1:], chain.T_last_flange)
    if chain.n != _TWISTS.size or any(chain.prismatic):
        return None
    a, d = [float(T[0, 3]) for T in steps], [float(T[2, 3]) for T in steps]
    rows = [dh_step(*row, 0.0) for row in zip(a, _TWISTS, d, strict=True)]
    crossing = max(map(abs, (a[0], *a[3:], d[4]))) < _SAME
    if not (crossing and np.allclose((np.eye(4), *rows), (chain.fixed[0], *steps), rtol=0.0, atol=_SAME)):
        return None
    return _Puma(d[0], a[1], d[1], d[2], a[2], d[3], d[5]) if math.dist((a[1], d[3]), _SIZE) < 0.02 else None


def _trunk(puma: _Puma) -> list[Part]:
    side = math.copysign(1.0, puma.offset)  # on which side of the trunk the arm hangs, along axis 2
    foot = merged([cylinder(0.092, (0.0, 0.016), 4e-3), cylinder(0.066, (0.016, 0.034), RIM)])
    column = cylinder(0.054, (0.030, puma.d1 - 0.072), RIM)
    # frame 1: z along axis 2, y up along the trunk, origin at the shoulder
    collar = cylinder(0.056, (-0.070, -0.058), 2e-3).moved(_UP)
    neck = cylinder(0.052, (-0.058, 0.0), RIM).moved(_UP)
    drum = cylinder(SHOULDER, _span(-side * 0.062, side * (_reach(puma) - 0.002)), RIM)
    return [
        Part("foot", 0, foot, DARK),
        Part("column", 0, column, WHITE),
        Part("collar", 1, collar, DARK),
        Part("shoulder", 1, merged([neck, drum]), WHITE),
    ]


def _reach(puma: _Puma) -> float:
    """From the trunk's axis to the near side of the upper arm, m, along axis 2."""
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


# The touched object as a sheet or a body of triangles, every vertex on its exact surface.

REACH_M = 0.055
"""How much of a surface without end is shown round the object's origin, to each side."""
WHOLE_M = 0.12
"""Largest radius of a body that is shown whole."""
STEPS = 40
LINES = 15
RELIEF = 161
"""Points along each side of a grid of heights."""


def object_mesh(shape: PlacedShape) -> Mesh:
    """The surface of an object near its origin, base frame.

    Balls, cylinders, bowls and rings of ordinary size are shown whole (a cylinder over `REACH_M` to each side),
    heights within `REACH_M`, everything else over a square of twice `REACH_M`.
    """
    radius = getattr(shape, "radius", math.inf)
    if radius <= WHOLE_M and isinstance(shape, Sphere):
        return _placed(shape, dome(radius, math.pi, rings=32), -radius)
    if radius <= WHOLE_M and isinstance(shape, Cylinder):
        return _placed(shape, _tube(radius, REACH_M), -radius)
    if radius <= WHOLE_M and isinstance(shape, Bowl):
        return _placed(shape, _hollow(radius), radius)
    if isinstance(shape, Heights):
        points, exists = _relief(shape)
        mesh = grid(points)
        used, faces = np.unique(mesh.faces[exists.ravel()[mesh.faces].all(axis=1)], return_inverse=True)
        return Mesh(mesh.vertices[used], faces.reshape(-1, 3))
    if isinstance(shape, Torus) and shape.ring_radius + radius <= WHOLE_M:
        return _ring(shape)
    return grid(_sheet(shape, REACH_M))


def object_lines(shape: PlacedShape) -> Array:
    """Lines on the surface in two directions, which make its curvature visible: (n, 2, 3) segments, base frame, m."""
    radius = math.inf if isinstance(shape, Cylinder) else getattr(shape, "radius", math.inf)
    if isinstance(shape, Heights):
        points, exists = _relief(shape)
        lines = _lines(np.where(exists[..., None], points, np.nan))
        return lines[np.isfinite(lines).all(axis=(1, 2))]
    sheet = _sheet(shape, min(REACH_M, 0.7 * radius))  # not over the edge of a body seen from above
    return _lines(sheet)


def _lines(sheet: Array) -> Array:
    rows, columns = (np.linspace(0, n - 1, LINES).round().astype(int) for n in sheet.shape[:2])
    along = [np.stack([sheet[i, :-1], sheet[i, 1:]], axis=1) for i in rows]
    across = [np.stack([sheet[:-1, j], sheet[1:, j]], axis=1) for j in columns]
    return np.concatenate([*along, *across])


def _relief(shape: Heights) -> tuple[Array, NDArray[np.bool_]]:
    """(m, n, 3) points of heights within `REACH_M` of the origin, base frame, and (m, n) whether the surface exists."""
    x, y = (
        np.linspace(max(low, -REACH_M), min(high, REACH_M), RELIEF)
        for low, high in zip(shape.spline.corner, shape.spline.far, strict=True)
    )
    x, y = (one.ravel() for one in np.meshgrid(x, y, indexing="ij"))
    local = np.column_stack((x, y, shape.spline.many(x, y)[0]))
    T = shape.T_base_object
    points: Array = (local @ T[:3, :3].T + T[:3, 3]).reshape(RELIEF, RELIEF, 3)
    return points, shape.exists(x, y).reshape(RELIEF, RELIEF)


def _sheet(shape: PlacedShape, reach_m: float) -> Array:
    """(STEPS + 1, STEPS + 1, 3) feet of a square of the tangent plane, base frame; its front side is outside."""
    T = shape.T_base_object
    across = min(reach_m, 0.85 * shape.radius) if isinstance(shape, Cylinder) else reach_m
    xs, ys = np.linspace(-reach_m, reach_m, STEPS + 1), np.linspace(-across, across, STEPS + 1)
    plane = [[T[:3, 3] + x * T[:3, 0] + y * T[:3, 1] + _height(shape, y) * T[:3, 2] for y in ys] for x in xs]
    return np.array([[shape.closest(point).point for point in row] for row in plane])


def _height(shape: PlacedShape, y: float) -> float:
    """Where to look for a foot: in the troughs too."""
    if isinstance(shape, Wave):
        return shape.amplitude * (math.cos(2.0 * math.pi * y / shape.wavelength) - 1.0)
    return 0.0


def _ring(shape: Torus) -> Mesh:
    """A whole torus."""
    angle = np.linspace(-math.pi, math.pi, 49)
    profile = np.column_stack([shape.ring_radius + shape.radius * np.cos(angle), shape.radius * np.sin(angle)])
    mesh = revolved(profile, 96)
    return _placed(shape, Mesh(mesh.vertices - (shape.ring_radius, 0.0, 0.0), mesh.faces), -shape.radius)


def _placed(shape: PlacedShape, mesh: Mesh, height_m: float) -> Mesh:
    T = np.array(shape.T_base_object)
    T[:3, 3] += height_m * T[:3, 2]
    return mesh.moved(T)


def _tube(radius: float, half: float) -> Mesh:
    """A cylinder along x, open at its ends."""
    angles = np.linspace(0.0, 2.0 * math.pi, 97)
    y, z = radius * np.cos(angles), radius * np.sin(angles)
    ends = [np.column_stack([np.full(len(angles), x), y, z]) for x in np.linspace(-half, half, 9)]
    return grid(np.stack(ends, axis=1))


def _hollow(radius: float) -> Mesh:
    """The inside of the lower half of a ball."""
    half = dome(radius, math.pi / 2)
    return Mesh(half.vertices * (1.0, -1.0, -1.0), half.faces[:, ::-1])


# The tactile array on its dome: where each taxel lies, and its image as colours.

FULL_COUNTS = 255
SHARE = 0.9
"""Side of a drawn taxel over the pitch."""
TAXEL_LIFT_M = 2e-4
"""How far above the dome taxels are drawn."""


def taxel_poses(pad: Pad, radius: float) -> tuple[Array, Array]:
    """Where the taxels lie on the probe.

    Args:
        pad: the taxels.
        radius: from the origin of the probe's frame to its pole, m.

    Returns:
        (n, 3) positions in the probe frame, m, and (n, 4) unit quaternions w, x, y, z that turn a tile lying in
        the xy plane to its place; row by row, v and then u rising.
    """
    directions = np.array([pad_to_direction(u, v, pad.radius_m) for u, v in pad.uv.tolist()])
    # the shortest turn from z to d: (1 + d_z, z × d), normalised
    turns = np.column_stack([1.0 + directions[:, 2], -directions[:, 1], directions[:, 0], np.zeros(len(directions))])
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    pole = np.array([0.0, 0.0, radius - pad.radius_m])
    return pole + (pad.radius_m + TAXEL_LIFT_M) * directions, turns


def tile(pad: Pad) -> tuple[Array, NDArray[np.int64]]:
    """One taxel: vertices (4, 3), m, and faces (2, 3), front side towards +z."""
    half = 0.5 * SHARE * pad.pitch_m
    corners = half * np.array(((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)), dtype=np.float64)
    return corners, np.array(((0, 1, 2), (0, 2, 3)))


def taxel_colours(taxels: NDArray[np.uint8]) -> Colours:
    """(..., 3) colours of counts; a square-root scale, so that the rim of a patch is seen."""
    return scale(np.sqrt(taxels.astype(np.float64)), 0.0, math.sqrt(FULL_COUNTS), MAGMA)


def taxel_image(taxels: NDArray[np.uint8], pixels: int) -> Colours:
    """The image as RGB, each taxel a square of so many pixels; v rises upward.

    Args:
        taxels: (rows, columns) counts, rows v, columns u.
        pixels: per taxel.
    """
    colours = taxel_colours(taxels[::-1])
    return np.repeat(np.repeat(colours, pixels, axis=0), pixels, axis=1)
