"""Cell files: what a scene takes from its cell, what it changes, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import pytest

from canprobe.cell.scene.arms import arm_model
from canprobe.cell.scene.load import dump_scene, load_cell, load_scene, packaged, parse_scene
from canprobe.errors import PlanError, SceneError

FREE = '[scene]\nname = "mine"\n[task]\nkind = "free"\n'
GANTRY = """
[cell]
name = "two"
[arm]
[joints.x]
kind = "prismatic"
min_mm = 0
max_mm = 100
speed_mm_s = 50
counts_per_m = 1000
[joints.turn]
min_deg = -90
max_deg = 90
speed_deg_s = 30
counts_per_turn = 4096
"""


def test_a_scene_without_a_cell_has_the_default_cell():
    assert load_scene("cylinder") == load_scene("cylinder", {"cell": "puma260"})


@pytest.mark.parametrize("cell", [name for name, _ in packaged("cell")])
def test_a_scene_reads_with_every_cell_and_is_written_whole(cell):
    read = load_scene("cylinder", {"cell": cell})
    assert parse_scene(dump_scene(read)) == read
    assert read.cell.name == load_cell(cell)["cell"]["name"]


def test_a_scene_changes_single_keys_of_its_cell():
    scene = parse_scene(f'cell = "puma560"\n{FREE}[joints.joint_2]\nnode_id = 12\n[bus]\nbitrate = 500000\n')
    assert list(scene.drives) == [1, 12, 3, 4, 5, 6]
    assert scene.joints["joint_2"].a_mm == 431.8
    assert scene.bus.bitrate == 500_000


def test_the_cell_that_is_given_replaces_the_one_that_the_scene_names(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(f'cell = "puma560"\n{FREE}')
    assert len(load_scene(path).joints) == 6
    assert len(load_scene(path, {"cell": "gantry"}).joints) == 3


def test_a_scene_finds_its_cell_and_the_cell_its_files_beside_it(tmp_path):
    (tmp_path / "hardware").mkdir()
    (tmp_path / "hardware" / "arm.eds").write_text("")
    (tmp_path / "hardware" / "cell.toml").write_text(GANTRY.replace("[arm]", '[arm]\neds = "arm.eds"'))
    path = tmp_path / "scene.toml"
    path.write_text(f'cell = "hardware/cell.toml"\n{FREE}')
    scene = load_scene(path)
    assert scene.arm is not None and scene.arm.eds == str(tmp_path / "hardware" / "arm.eds")
    assert list(scene.joints) == ["x", "turn"]


def test_a_scene_that_describes_its_cell_takes_nothing_from_another_one(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(FREE + GANTRY)
    scene = load_scene(path)
    assert (scene.cell.name, list(scene.joints)) == ("two", ["x", "turn"])
    with pytest.raises(SceneError, match="describes its cell itself"):
        load_scene(path, {"cell": "puma260"})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('cell = "puma2600"\n' + FREE, "puma2600: no such cell or file; did you mean puma260"),
        ("cell = 5\n" + FREE, "cell: expected the name or the path of a cell, got 5"),
        (FREE + '[cell]\nname = "bare"\n', 'joints: missing: task.kind = "free" needs'),
        (FREE + "[joints.joint_2]\nnode_id = 1\n", "joints.joint_2.node_id: expected node ids all different"),
        (FREE + "[joints.joint_2]\nmin_mm = 1\n", 'joints.joint_2.min_mm: only with kind = "prismatic"'),
        (FREE + "[joints.joint_2]\ncoupling = { joint_9 = 1 }\n", "joints.joint_2.coupling: expected names of other"),
        (FREE + GANTRY.replace("counts_per_m = 1000", ""), "joints.x.counts_per_m: missing"),
        (FREE + GANTRY.replace("max_deg = 90", ""), "joints.turn.max_deg: missing"),
        (FREE + "[joints]\njoint_2 = 3\n", "joints.joint_2: expected a section [joints.joint_2], got 3"),
    ],
)
def test_what_is_wrong_is_named_with_its_key(text, said):
    with pytest.raises(SceneError) as refused:
        parse_scene(text)
    assert said in str(refused.value)


def test_a_cell_file_holds_hardware_alone(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(GANTRY + '[task]\nkind = "free"\n')
    with pytest.raises(SceneError, match="task: unknown section"):
        load_cell(path)


def test_mistakes_in_a_cell_name_the_cell_file(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(GANTRY.replace("4096", '"many"'))
    with pytest.raises(SceneError, match=r"cell\.toml: joints\.turn\.counts_per_turn: expected a number"):
        load_scene("free", {"cell": path})


@pytest.mark.parametrize(
    ("moments", "why"),
    [((-1, 1, 1, 0, 0, 0), "negative"), ((1, 1, 9, 0, 0, 0), "larger than the sum"), ((1, 1, 1, 5, 0, 0), "negative")],
)
def test_an_inertia_that_no_body_has_is_refused(moments, why):
    sections = load_scene("cylinder").joints
    name = next(iter(sections))
    odd = {**sections, name: replace(sections[name], mass_kg=1.0, inertia_kg_m2=tuple(map(float, moments)))}
    with pytest.raises(PlanError, match=rf"joints\.{name}\.inertia_kg_m2: expected .* {why}"):
        arm_model("odd", load_scene("cylinder").arm, odd)


def test_a_scene_of_another_cell_says_where_it_touches():
    text = 'cell = "puma560"\n[scene]\nname = "mine"\n[task]\nkind = "press"\n[object]\nkind = "plane"\n'
    with pytest.raises(SceneError, match=r"task\.start_mm: missing: .* place of the cell puma260, not of puma560"):
        parse_scene(text)
    assert parse_scene(text.replace('"puma560"', '"puma260"')).task.start_mm == (-120.0, -122.5, 374.0)
    own = dump_scene(load_scene("cylinder"))
    assert parse_scene(own).task.start_mm == (-120.0, -122.5, 374.0)
    with pytest.raises(SceneError, match=r"task\.start_mm: missing: .* puma260, not of the scene's own \[cell\]"):
        parse_scene(own.replace("start_mm = [-120.0, -122.5, 374.0]\n", ""))
