"""The shapes of the 3-D view: links against forward kinematics, ghosts and patches against exact surfaces."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import canprobe
from canprobe.cell.plant.pressure import pad_coordinates
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.lab.bridge.sample import ContactFrame
from canprobe.lab.bridge.view import array_dome as taxels
from canprobe.lab.bridge.view import colours, links
from canprobe.lab.bridge.view import object_sheet as objects
from canprobe.lab.bridge.view.path import PathAhead, deviation_scale
from canprobe.lab.bridge.view.surface import LIFT_M, GrowingSurface, drawn, map_of_points
from canprobe.mechanics.robot.chain import link_frames, posture
from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset
from canprobe.mechanics.touch.objects import OBJECT_PARAMETERS, make_object
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation


def winding(mesh, point):
    """How often a closed mesh goes round a point: 1 inside, 0 outside (van Oosterom and Strackee, 1983)."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] - point for i in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    dot = lambda x, y: np.einsum("ij,ij->i", x, y)  # noqa: E731
    over = dot(a, np.cross(b, c))
    under = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return float(np.sum(2.0 * np.arctan2(over, under)) / (4.0 * math.pi))


def normals(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def face_middles(mesh):
    return mesh.vertices[mesh.faces].mean(axis=1)


# the arm


@pytest.mark.parametrize("cell", ["puma260", "seven-axis", "gantry"])
def test_every_link_has_a_closed_body_the_right_way_out_and_every_joint_lies_in_one(cell):
    arm = resolve(load_scene("free", {"cell": cell})).arm.model
    parts, lines = links.arm_links(load_scene("free", {"cell": cell}).arm, arm.chain)
    assert not lines and len({part.name for part in parts}) == len(parts)
    assert {part.frame for part in parts} >= set(range(arm.n)) and all(part.mesh.is_volume for part in parts)
    q = 0.5 * (arm.q_min + arm.q_max)
    frames, at = link_frames(arm.chain, q), posture(arm.chain, q)
    bodies = [part.mesh.copy().apply_transform(frames[part.frame]) for part in parts]
    for origin in np.array(at.origins):
        assert max(winding(body, origin) for body in bodies) > 0.5


def test_the_probe_is_a_ball_with_a_holder_from_the_flange():
    tool = tool_z_offset(80.0)
    holder, elastic = taxels.probe_parts(0.04, tool)
    assert np.linalg.norm(elastic.vertices, axis=1) == pytest.approx(0.04)
    assert elastic.vertices[:, 2].max() == pytest.approx(0.04)
    assert holder.volume > 0 and holder.vertices[:, 2].min() == pytest.approx(-0.08)
    assert np.linalg.norm(holder.vertices[holder.vertices[:, 2] > -0.02], axis=1).max() < 0.04
    assert np.einsum("ij,ij->i", normals(elastic), face_middles(elastic)).min() > -1e-15


# the array


def test_taxels_lie_where_the_plant_has_them():
    radius, pitch = 0.04, 0.0254 / 16
    places, turns = taxels.taxel_poses(Pad(), radius)
    for k, (place, (w, x, y, z)) in enumerate(zip(places, turns, strict=True)):
        direction = place / np.linalg.norm(place)
        u, v = pad_coordinates(tuple(direction), radius)
        assert (u / pitch + 7.5, v / pitch + 7.5) == pytest.approx((k % 16, k // 16), abs=1e-9)
        up = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))  # where the quaternion takes z
        assert up == pytest.approx(direction, abs=1e-12)
    assert np.linalg.norm(places, axis=1) == pytest.approx(radius + taxels.TAXEL_LIFT_M)


def test_the_image_has_u_to_the_right_and_v_upward():
    counts = np.zeros((16, 16), np.uint8)
    counts[0, 15] = 255  # lowest v, highest u
    image = taxels.taxel_image(counts, pixels=2)
    bright = np.argwhere(image.sum(axis=2) > 300)
    assert bright.min(axis=0).tolist() == [30, 30] and bright.max(axis=0).tolist() == [31, 31]


# objects

POSE = homogeneous(tangent_rotation(np.array([0.36, -0.48, 0.8])), np.array([-0.12, 0.1, 0.37]))
HEIGHTS = -np.add.outer(np.linspace(-0.05, 0.05, 51) ** 2, 2 * np.linspace(-0.04, 0.04, 41) ** 2)
BALL = trimesh.creation.uv_sphere(radius=0.03, count=(100, 100))
KINDS = {
    "heights": {"heights": HEIGHTS, "spacing": 2e-3, "origin": (0, 0)},
    "mesh": {"vertices": BALL.vertices, "faces": BALL.faces, "spacing": 2e-3, "origin": (0, 0)},
    "plane": {},
    "sphere": {"radius": 0.03},
    "large sphere": {"radius": 0.5},
    "cylinder": {"radius": 0.036},
    "large cylinder": {"radius": 0.4},
    "ellipsoid": {"radius_x": 0.08, "radius_y": 0.06, "radius_z": 0.05},
    "torus": {"ring_radius": 0.06, "radius": 0.02},
    "large torus": {"ring_radius": 0.4, "radius": 0.1},
    "wave": {"amplitude": 4e-3, "wavelength": 0.04},
    "fillet": {"radius": 0.02, "angle": 1.0},
    "saddle": {"radius_x": 0.05, "radius_y": -0.12},
    "bowl": {"radius": 0.08},
    "large bowl": {"radius": 0.6},
    "quadric": {"matrix": np.array([[6, 2, 0, 0], [2, 9, 0, 0], [0, 0, 3, 0.5], [0, 0, 0.5, 0]], float)},
}


def test_every_kind_of_object_has_a_ghost_here():
    assert {name.split()[-1] for name in KINDS} == set(OBJECT_PARAMETERS)


@pytest.mark.parametrize("name", KINDS)
def test_ghosts_lie_on_the_exact_surface_with_their_front_outside(name):
    shape = make_object(name.split()[-1], T_base_object=POSE, **KINDS[name])
    mesh = objects.object_mesh(shape)
    some = 27 if name in ("heights", "mesh") else 1  # whose feet take longer
    feet = [shape.closest(vertex) for vertex in mesh.vertices[::some]]
    assert max(abs(foot.distance) for foot in feet) < 1e-9
    flat = np.linalg.norm(normals(mesh), axis=1) < 1e-12
    outward = np.array([shape.closest(p).normal for p in face_middles(mesh)[~flat][::some]])
    n = normals(mesh)[~flat][::some]
    assert np.einsum("ij,ij->i", n / np.linalg.norm(n, axis=1, keepdims=True), outward).min() > 0.9
    assert np.linalg.norm(mesh.vertices - POSE[:3, 3], axis=1).min() < 0.006  # it is there where it is touched
    lines = objects.object_lines(shape)
    assert max(abs(shape.closest(p).distance) for p in lines.reshape(-1, 3)[::7]) < 1e-9


# the recovered surface


def touched(angles, radius=0.05):
    """Contacts on a ball about the origin, three passes 2 mm apart."""
    for side in (-0.04, 0.0, 0.04):
        for a in angles:
            n = np.array([math.sin(a), side, math.cos(a)]) / math.hypot(1.0, side)
            yield ContactFrame(homogeneous(tangent_rotation(-n), radius * n))


def test_the_recovered_surface_lies_on_the_ball_and_has_the_colours_of_what_is_known():
    solids, scale = [], deviation_scale(None, None)
    scene = SimpleNamespace(add_mesh_trimesh=lambda name, solid, **_: solids.append((name, solid)))
    surface = GrowingSurface(scene, scale, 0.04)
    surface.refresh()
    assert not solids  # nothing was touched
    for angles in (np.arange(-0.5, 0.0, 0.005), np.arange(0.0, 0.5, 0.005)):
        for one in touched(angles):
            surface.add(one)
        surface.refresh()
    surface.refresh()  # nothing new: nothing is sent
    (_, half), (name, solid) = solids
    assert name == "/surface"
    assert np.linalg.norm(solid.vertices, axis=1) == pytest.approx(0.05 + LIFT_M, abs=10e-6)
    assert np.ptp(np.arctan2(solid.vertices[:, 0], solid.vertices[:, 2])) == pytest.approx(1.14, abs=0.06)
    assert half.area < 0.6 * solid.area
    known = (solid.visual.vertex_colors[:, :3] != scale.colours(np.array([math.inf]))).any(axis=1)
    assert known.mean() > 0.9  # three passes show both curvatures


def test_an_exploration_is_coloured_by_what_it_does_not_know_and_shows_the_path_ahead():
    scale = deviation_scale(None, canprobe.plan("explore").setup.scan)
    surface = map_of_points(0.04)
    contacts = list(touched(np.arange(-0.2, 0.2, 0.005)))
    surface.add([one.point for one in contacts], [one.normal for one in contacts])
    mesh, colours = drawn(surface, scale)
    sure, unsure = mesh.sigma.argmin(), mesh.sigma.argmax()
    assert colours[sure].sum() > colours[unsure].sum()  # bright for a small deviation of the height
    assert "height" in scale.text
    lines = {}
    ahead = PathAhead(
        SimpleNamespace(add_line_segments=lambda name, segments, *_, **__: lines.update({name: segments}))
    )
    ahead.refresh()
    assert not lines
    ahead.take(np.arange(12.0).reshape(4, 3))
    ahead.refresh()
    assert lines["/ahead"].shape == (3, 2, 3)


# colours


def test_colours_rise_in_lightness_and_tell_what_is_unknown():
    scale = colours.scale(np.linspace(-1.0, 3.0, 200), 0.0, 2.0).astype(float)
    lightness = scale @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(lightness) >= -1.0).all() and lightness[-1] - lightness[0] > 150
    assert (scale[:50] == scale[0]).all() and scale[0].tolist() == [68, 1, 84]
    assert colours.scale([math.nan, math.inf], 0.0, 1.0).tolist() == [list(colours.UNKNOWN)] * 2


def test_linear_light_is_undone_by_the_screen():
    """Encoded as a screen does it (IEC 61966-2-1), within what eight bits of light leave of dark colours."""
    rgb = np.arange(0, 256, 5, dtype=np.uint8)
    light = colours.linear_light(rgb) / 255.0
    shown = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055) * 255.0
    assert shown == pytest.approx(rgb, abs=7.0) and shown[20:] == pytest.approx(rgb[20:], abs=1.0)
