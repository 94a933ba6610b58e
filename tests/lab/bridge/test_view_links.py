"""Links as a URDF shows them: from `canprobe init` over a run to the page, and after the meshes are gone."""

import json
import re

import numpy as np
import pytest
import trimesh

from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cli import main
from canprobe.lab.bridge.view.links import arm_links

URDF = """<robot name="lab">
  <link name="base"><visual><geometry><mesh filename="package://lab/meshes/base.stl" scale="0.001 0.001 0.001"/>
    </geometry><material name="red"><color rgba="1 0 0 1"/></material></visual></link>
  <link name="arm"><visual><origin xyz="0.1 0 0" rpy="0 0 0.5"/><geometry>
    <mesh filename="../meshes/arm.obj"/></geometry></visual>
    <visual><geometry><sphere radius="0.05"/></geometry></visual></link>
  <link name="hand"><visual><geometry><mesh filename="package://lab/meshes/hand.dae"/></geometry></visual></link>
  <link name="tool"/>
  <joint name="lift" type="prismatic"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.2"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.5" effort="300" velocity="0.5"/></joint>
  <joint name="turn" type="revolute"><parent link="arm"/><child link="hand"/><origin xyz="0.3 0 0"/><axis xyz="0 -1 0"/>
    <limit lower="-2" upper="2" effort="50" velocity="2"/></joint>
  <joint name="end" type="fixed"><parent link="hand"/><child link="tool"/><origin xyz="0.2 0 0"/></joint>
</robot>
"""


@pytest.fixture
def lab(tmp_path):
    """A cell of a URDF whose meshes are boxes of 200 x 100 x 60 mm; the one of the hand is no mesh."""
    folder = tmp_path / "lab"
    for part in ("urdf", "meshes"):
        (folder / part).mkdir(parents=True)
    (folder / "urdf" / "lab.urdf").write_text(URDF)
    trimesh.creation.box((200, 100, 60)).export(folder / "meshes" / "base.stl")
    trimesh.creation.box((0.2, 0.1, 0.06)).export(folder / "meshes" / "arm.obj")
    (folder / "meshes" / "hand.dae").write_text("nothing")
    cell = tmp_path / "cell"
    assert main(["init", str(cell), "--urdf", str(folder / "urdf" / "lab.urdf"), "--tip", "tool"]) == 0
    text = (cell / "cell.toml").read_text().replace("mount_mm = [0, 0, 0]", "mount_mm = [1000, 0, 0]")
    (cell / "cell.toml").write_text(text)
    return cell


def drawn(path):
    scene = load_scene(path)
    return arm_links(scene.arm, resolve(scene).arm.model.chain)


def test_meshes_are_drawn_in_their_frames_and_what_cannot_be_read_is_said(lab):
    parts, lines = drawn(lab / "cell.toml")
    assert len(lines) == 1 and re.match(r"lab\.urdf: hand\.dae: cannot be read: .*; simple links are drawn", lines[0])
    solid = {part.name: part for part in parts if part.name.startswith("solid")}
    assert [part.frame for part in solid.values()] == [0, 1, 1]
    base, arm, ball = (part.mesh.vertices for part in solid.values())
    assert solid["solid_1_1"].colour == (255, 0, 0)
    assert np.ptp(base, axis=0) == pytest.approx((0.2, 0.1, 0.06)) and base.mean(axis=0)[0] == pytest.approx(1.0)
    assert {part.frame for part in parts if part not in solid.values()} == {2}
    # frame 1 is where joint 2 begins: 300 mm along x from the link that carries the mesh, its z along -y
    centre = ball.min(axis=0) + np.ptp(ball, axis=0) / 2
    assert np.linalg.norm(centre) == pytest.approx(0.3, abs=1e-6)
    assert np.linalg.norm(arm.mean(axis=0)) == pytest.approx(0.2)
    assert np.ptp(arm, axis=0)[2] == pytest.approx(0.2 * np.sin(0.5) + 0.1 * np.cos(0.5))  # along y of the link


def test_a_run_shows_the_meshes_as_long_as_they_are_there(lab, tmp_path, capsys):
    out = tmp_path / "run"
    (lab / "free.toml").write_text('cell = "cell.toml"\n[scene]\nname = "free"\n[task]\nkind = "free"\n')
    assert main(["run", str(lab / "free.toml"), "--duration", "0.2", "--no-figures", "--out", str(out)]) == 0
    assert len(drawn(out / "scene.toml")[0]) == len(drawn(lab / "cell.toml")[0])
    for mesh in (tmp_path / "lab" / "meshes").iterdir():
        mesh.unlink()
    page = tmp_path / "page.html"
    assert main(["view", str(out), "--html", str(page)]) == 0
    line = "lab.urdf: base.stl, arm.obj, hand.dae: not found beside the URDF; simple links are drawn"
    assert line in capsys.readouterr().err
    notes = json.loads(re.search(r"const run = (\{.*\});\n", page.read_text(encoding="utf-8"))[1])["notes"]
    assert notes == [line]
    parts, _ = drawn(out / "scene.toml")
    assert {part.frame for part in parts if not part.name.startswith("solid")} == {0, 1, 2}
