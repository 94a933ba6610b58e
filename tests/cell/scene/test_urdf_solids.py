"""Spheres round the links of an arm from the collision solids of its URDF, against the solids themselves."""

from __future__ import annotations

import re
import sys

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

import canprobe
from canprobe.cell.scene.load import packaged_files
from canprobe.cell.scene.urdf_solids import MAX_SPHERES, link_spheres, mesh_spheres
from canprobe.cell.tasks.hand_way import joint_way
from canprobe.errors import UsageError
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.keep_out import KeepOut
from canprobe.mechanics.robot.urdf import from_urdf

PRBT = packaged_files("cells")["prbt"].with_suffix(".urdf").read_text()
PRIMITIVES = {
    "prbt_link_2": '<collision><origin xyz="0 0.175 0.02"/><geometry><box size="0.1 0.5 0.08"/></geometry></collision>',
    "prbt_link_3": '<collision><origin xyz="0 0 0.15" rpy="0.3 0 0"/><geometry><cylinder radius="0.06" length="0.3"/>'
    '</geometry></collision><collision><geometry><sphere radius="0.07"/></geometry></collision>',
}
TURNED = """<robot name="turned"><link name="base"/>
  <link name="one"><collision><geometry><mesh filename="one.stl"/></geometry></collision></link>
  <link name="two"><collision><origin xyz="0.1 0 0" rpy="0 0.4 0"/>
    <geometry><mesh filename="package://lab/two.obj" scale="0.001 0.001 -0.001"/></geometry></collision></link>
  <link name="three"><collision><geometry><mesh filename="three.dae"/></geometry></collision></link>
  <link name="tool"/>
  <joint name="a" type="revolute"><parent link="base"/><child link="one"/><axis xyz="0 0 1"/>
    <origin xyz="0 0 0.3"/><limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
  <joint name="b" type="revolute"><parent link="one"/><child link="two"/><axis xyz="0 1 0"/>
    <origin xyz="0 0 0.2" rpy="0 0 0.5"/><limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <joint name="c" type="prismatic"><parent link="two"/><child link="three"/><axis xyz="1 0 0"/>
    <origin xyz="0.4 0 0"/><limit lower="0" upper="0.2" velocity="1" effort="1"/></joint>
  <joint name="d" type="fixed"><parent link="three"/><child link="tool"/><origin xyz="0 0 0.1"/></joint></robot>"""
"""A joint whose axis is not z, one that slides along x, and meshes of three formats; that of the column is not read."""


def with_collisions(folder, solids=PRIMITIVES):
    text = PRBT
    for link, solid in solids.items():
        text = text.replace(f'<link name="{link}"/>', f'<link name="{link}">{solid}</link>')
    path = folder / "prbt.urdf"
    path.write_text(text)
    return path


def turned(folder):
    """Its path, and the vertices of each link in the frame of the link, m."""
    two = trimesh.creation.capsule(height=300.0, radius=40.0)
    three = trimesh.creation.annulus(0.02, 0.05, 0.3)
    (folder / "turned.urdf").write_text(TURNED)
    two.export(folder / "two.obj")
    (folder / "three.dae").write_bytes(three.export(file_type="dae"))
    assert not (folder / "one.stl").exists(), "the column stands where it stands"
    T = trimesh.transformations.euler_matrix(0.0, 0.4, 0.0) @ np.diag([1e-3, 1e-3, -1e-3, 1.0])
    T[0, 3] = 0.1
    return folder / "turned.urdf", {"two": two.apply_transform(T).vertices, "three": three.vertices}


@pytest.mark.filterwarnings("ignore:Setting the shape:DeprecationWarning")  # pycollada 0.9 with NumPy 2.5
def test_spheres_of_meshes_contain_their_vertices_wherever_the_arm_stands(tmp_path):
    urdf, vertices = turned(tmp_path)
    arm = from_urdf(urdf, "base", "tool")
    spheres, lines = link_spheres(urdf, "base", "tool", arm.chain)
    assert lines == () and sorted({*spheres[:, 0]}) == [2, 3] and len(spheres) <= 2 * MAX_SPHERES
    q = np.array([0.7, -0.4, 0.15])
    for joint, link in ((2, "two"), (3, "three")):
        at = forward(from_urdf(urdf, "base", link).chain, q[:joint])
        points = vertices[link] @ at[:3, :3].T + at[:3, 3]
        keep_out = KeepOut(-np.inf, np.repeat(points[:, None], 2, axis=1)[:1], 0.0, np.zeros(3), 0.0, spheres)
        for point in points:
            object.__setattr__(keep_out, "boxes", np.array([[point, point]]))
            assert f"the link of joint {joint} comes" in (keep_out.touched(arm.chain, q) or "nothing")


@given(st.integers(0, 10**6), st.floats(0.02, 50.0))
def test_spheres_contain_a_mesh_between_its_vertices_too(seed, stretch):
    """Long facets, whose corners are slices apart: points of each one lie in some sphere."""
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(int(rng.integers(4, 12)), 3)) * (stretch, 1.0, 0.3)
    faces = np.array([rng.choice(len(vertices), 3, replace=False) for _ in range(8)])
    edges = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    spheres = mesh_spheres(vertices, edges)
    assert 1 <= len(spheres) <= MAX_SPHERES
    weights = rng.dirichlet((0.5, 0.5, 0.5), size=(8, 40))
    points = np.vstack([vertices, np.einsum("fwk,fkj->fwj", weights, vertices[faces]).reshape(-1, 3)])
    depth = np.min([np.linalg.norm(points - centre, axis=1) - radius for centre, radius in spheres], axis=0)
    assert depth.max() <= 1e-9


def test_spheres_of_a_box_a_cylinder_and_a_sphere_contain_them_and_not_much_more(tmp_path):
    urdf = with_collisions(tmp_path)
    chain = from_urdf(urdf, "prbt_base", "prbt_flange").chain
    spheres, lines = link_spheres(urdf, "prbt_base", "prbt_flange", chain)
    assert lines == () and [int(n) for n in np.unique(spheres[:, 0], return_counts=True)[1]] == [8, 6]
    keep_out = KeepOut(0.0, np.zeros((0, 2, 3)), 0.0, np.zeros(3), 0.0, spheres)
    lying = np.radians([0.0, 90.0, 0.0, 0.0, 0.0, 0.0])  # the box along the floor, 260.4 mm above it
    for floor, touches in ((0.2604 - 0.05, True), (0.2604 - 0.05 * np.sqrt(2.0) - 0.015, False)):
        object.__setattr__(keep_out, "floor", floor)
        assert ("the link of joint 2 comes" in (keep_out.touched(chain, lying) or "")) is touches


def way(urdf, goal_deg, **keep_out):
    keys = {f"keep_out.{key}": value for key, value in keep_out.items()}
    plan = canprobe.plan(canprobe.load_scene("prbt", {"arm.urdf": str(urdf), "outputs.figures": False, **keys}))
    return plan, joint_way(plan, plan.setup.arm.q_start, np.radians(goal_deg))


THIN = {f"prbt_link_{n}": '<collision><geometry><sphere radius="0.01"/></geometry></collision>' for n in range(2, 7)}
FIN = {"prbt_link_2": '<collision><origin xyz="0 0.15 0"/><geometry><box size="0.04 0.1 0.6"/></geometry></collision>'}
"""0.3 m to both sides of link 2, along the axis of joint 2, which joint 1 turns."""


@pytest.mark.parametrize(
    ("solids", "radius_mm", "refused"),
    [(FIN, 20, r"[1-9]\.\d\d s after"), ({}, 20, None), (THIN, 185, None), ({}, 185, r"[1-9]\.\d\d s after")],
    ids=["fin", "radius", "thin", "thick radius"],
)
def test_a_way_is_refused_by_the_solids_of_the_arm_and_not_by_a_radius(solids, radius_mm, refused, tmp_path):
    """Joint 1 turns round a column; a post stands 0.18 m behind it, where the fin comes by after a quarter turn."""
    post = [[-660, -127.5, 400], [-650, -117.5, 410]]
    keys = {"boxes_mm": [post], "link_radius_mm": radius_mm}
    _, found = way(with_collisions(tmp_path, solids), [120, 7, -88, 0, -85, 0], **keys)
    if refused is None:
        assert found.whole().looked_at
    else:
        with pytest.raises(
            UsageError, match=rf"the link of joint 2 comes to -\d+ mm from box 1 of .*, {refused} the start"
        ):
            found.whole()


@pytest.mark.parametrize("lost", ["file", "trimesh", "damaged"])
def test_a_mesh_that_is_not_there_is_one_line_and_its_link_has_the_radius(lost, tmp_path, monkeypatch):
    for name in ("a", "b"):
        trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / f"{name}.stl")
    mesh = '<collision><geometry><mesh filename="{}.stl"/></geometry></collision>'
    solids = {f"prbt_link_{n}": mesh.format(name) for n, name in ((2, "a"), (4, "a"), (5, "b"))}
    urdf = with_collisions(tmp_path, solids)
    said = {
        "file": "not found beside the URDF",
        "trimesh": r"needs trimesh; type: .* install .*view",
        "damaged": "cannot",
    }
    if lost == "trimesh":
        monkeypatch.setitem(sys.modules, "trimesh", None)
    elif lost == "file":
        (tmp_path / "a.stl").unlink()
    else:
        (tmp_path / "a.stl").write_bytes(b"solid nothing")
    plan, _ = way(urdf, [0] * 6, floor_mm=-500.0)
    links = "2, 4, 5" if lost == "trimesh" else "2, 4"
    (line,) = [warning for warning in plan.warnings if "collision" in warning]
    assert re.fullmatch(
        rf"prbt.urdf: collision of joint {links}: a.stl: .*{said[lost]}.*; .* takes link_radius_mm there", line
    )
    assert {*plan.setup.limits.keep_out.spheres[:, 0]} == (set() if lost == "trimesh" else {5})
    assert not any("collision" in warning for warning in way(urdf, [0] * 6)[0].warnings), (
        "without [keep_out] none is read"
    )
