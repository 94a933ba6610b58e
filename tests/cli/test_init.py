"""`canprobe init`: a cell file and a first scene from files that nobody here wrote, and what is refused."""

from __future__ import annotations

import json
import re
import tomllib

import numpy as np
import pytest

from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cli import main
from canprobe.fieldbus.eds.packaged import eds_path

URDF = """<robot name="lab">
  <link name="floor"/><link name="carriage"/><link name="l1"/><link name="l2"/><link name="l3"/><link name="l4"/>
  <link name="l5"/><link name="l6"/>
  <joint name="rail" type="prismatic"><parent link="floor"/><child link="carriage"/><axis xyz="0 1 0"/>
    <limit lower="-0.5" upper="0.5" effort="300" velocity="0.5"/></joint>
  <joint name="j1" type="revolute"><parent link="carriage"/><child link="l1"/><origin xyz="0 0 0.3"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="50" velocity="2"/></joint>
  <joint name="j2" type="revolute"><parent link="l1"/><child link="l2"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="50" velocity="2"/></joint>
  <joint name="j3" type="revolute"><parent link="l2"/><child link="l3"/><origin xyz="0 0 0.4"/><axis xyz="0 1 0"/>
    <limit lower="-2.5" upper="2.5" effort="50" velocity="2"/></joint>
  <joint name="j4" type="revolute"><parent link="l3"/><child link="l4"/><origin xyz="0 0 0.35"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="20" velocity="3"/></joint>
  <joint name="j5" type="revolute"><parent link="l4"/><child link="l5"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="20" velocity="3"/></joint>
  <joint name="j6" type="continuous"><parent link="l5"/><child link="l6"/><origin xyz="0 0 0.08"/>
    <axis xyz="0 0 1"/></joint>
</robot>
"""


@pytest.fixture
def urdf(tmp_path):
    path = tmp_path / "lab.urdf"
    path.write_text(URDF)
    return path


def test_without_a_urdf_the_file_begins_with_rows(tmp_path, capsys):
    assert main(["init", str(tmp_path / "cell")]) == 0
    assert main(["plan", str(tmp_path / "cell" / "first.toml")]) == 0
    assert "a_mm" in (tmp_path / "cell" / "cell.toml").read_text()


def test_a_cell_alone_is_planned_as_free_motion(tmp_path, urdf, capsys):
    assert main(["init", str(tmp_path / "cell"), "--urdf", str(urdf)]) == 0
    assert "next: canprobe plan" in capsys.readouterr().out
    assert main(["plan", str(tmp_path / "cell" / "cell.toml"), "--full"]) == 0
    assert "free" in capsys.readouterr().out
    joints = tomllib.loads((tmp_path / "cell" / "cell.toml").read_text())["joints"]
    assert list(joints) == ["rail", "j1", "j2", "j3", "j4", "j5", "j6"]
    assert joints["rail"]["kind"] == "prismatic"
    assert joints["j6"]["speed_deg_s"] > 0, "the URDF has none"


def test_the_cell_has_the_rate_of_its_drives_and_images_that_divide_it(tmp_path, capsys):
    eds = tmp_path / "4ms.eds"
    text = eds_path("puma260_joint").read_text()
    head, _, rest = text.partition("[60C2sub1]")
    section, mark, tail = rest.partition("\n[")
    section = section.replace("AccessType=rw", "AccessType=ro").replace("DefaultValue=25", "DefaultValue=4")
    eds.write_text(f"{head}[60C2sub1]{section}{mark}{tail}")
    assert main(["init", str(tmp_path / "cell"), "--eds", str(eds)]) == 0
    cell = tomllib.loads((tmp_path / "cell" / "cell.toml").read_text())
    assert (cell["cycle"]["rate_hz"], cell["sensor"]["rate_hz"]) == (250, 125)
    first = tomllib.loads((tmp_path / "cell" / "first.toml").read_text())
    assert first["task"]["kind"] == "scan" and not {"cycle", "sensor"} & set(first)
    assert main(["plan", str(tmp_path / "cell" / "cell.toml")]) == 0


def test_an_eds_that_cannot_be_driven_is_to_be_corrected(tmp_path, urdf, capsys):
    eds = tmp_path / "bad.eds"
    eds.write_text(eds_path("puma260_joint").read_text().replace("60C2", "6100").replace("1006", "1FF6"))
    assert main(["init", str(tmp_path / "cell"), "--urdf", str(urdf), "--eds", str(eds)]) == 2
    said = capsys.readouterr().err
    assert "60C2h" in said and "if it is right, this cell needs other devices; nothing was written" in said
    assert not (tmp_path / "cell").exists()


def only(folder, name, *rates):
    """The EDS of the packaged drive with these bit rates, kbit/s."""
    path = folder / name
    text = eds_path("puma260_joint").read_text()
    path.write_text(re.sub(r"BaudRate_(\d+)=\d", lambda m: f"BaudRate_{m[1]}={int(int(m[1]) in rates)}", text))
    return str(path)


@pytest.mark.slow(reason="plans at several bit rates")
def test_the_bus_has_the_fastest_bit_rate_that_all_files_have(tmp_path, capsys):
    files = [only(tmp_path, "slow.eds", 125, 500), *[only(tmp_path, "fast.eds", 125, 500, 1000)] * 5]
    assert main(["init", str(tmp_path / "cell"), *(word for file in files for word in ("--eds", file))]) == 0
    assert tomllib.loads((tmp_path / "cell" / "cell.toml").read_text())["bus"]["bitrate"] == 500_000


def test_files_without_a_common_bit_rate_are_named(tmp_path, urdf, capsys):
    eds = only(tmp_path, "odd.eds", 800)
    assert main(["init", str(tmp_path / "cell"), "--urdf", str(urdf), "--eds", eds]) == 2
    said = capsys.readouterr().err
    assert f"{eds} has 800000 bit/s; tactile_array has" in said and "correct" not in said


def test_why_the_first_scene_does_not_scan_is_said(tmp_path, urdf, capsys):
    assert main(["init", str(tmp_path / "cell"), "--urdf", str(urdf), "--tip", "l1"]) == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "freely" in line]
    assert "a scan was refused: joints: in its start posture" in line
    assert 'kind = "free"' in (tmp_path / "cell" / "first.toml").read_text()


def test_a_misspelt_joint_is_said_with_all_other_mistakes(tmp_path, urdf, capsys):
    assert main(["init", str(tmp_path / "cell"), "--urdf", str(urdf)]) == 0
    cell = tmp_path / "cell" / "cell.toml"
    cell.write_text(cell.read_text().replace("[joints.rail]", "[joints.rial]").replace("gear =", "gera ="))
    assert main(["plan", str(cell)]) == 2
    assert "joints.rial: no joint of" in capsys.readouterr().err
    assert main(["plan", str(tmp_path / "cell" / "first.toml")]) == 2
    said = capsys.readouterr().err
    assert "joints.rial: no joint of" in said and "did you mean rail?" in said and "joints.j6.gera: unknown key" in said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--tip", "l6"], "give it with --urdf FILE"),
        (["--urdf", "nowhere.urdf"], "nowhere.urdf: no such file"),
        (["--urdf", "URDF", "--tip", "hand"], "no link 'hand'; it has"),
        (["--urdf", "URDF", "--eds", "URDF", "--eds", "URDF"], "one for each of the 7 joints, got 2"),
        (["--urdf", "URDF", "--eds", "prbt_jont"], "no such packaged file; did you mean prbt_joint?"),
    ],
)
def test_what_is_refused(tmp_path, urdf, capsys, arguments, said):
    words = [str(urdf) if word == "URDF" else word for word in arguments]
    assert main(["init", str(tmp_path / "cell"), *words]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "cell" / "first.toml").exists()


def test_nothing_is_overwritten(tmp_path, urdf, capsys):
    assert main(["init", str(tmp_path / "cell"), "--urdf", str(urdf)]) == 0
    assert main(["init", str(tmp_path / "cell"), "--urdf", str(urdf)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_a_failed_init_leaves_nothing_behind(tmp_path, urdf, capsys):
    (eds := tmp_path / "drive.eds").write_text("[FileInfo]\n")
    folder = tmp_path / "new" / "cell"
    command = ["init", str(folder), "--urdf", str(urdf), "--eds", str(eds)]
    assert main(command) == 2
    assert "drive.eds" in capsys.readouterr().err
    assert not folder.parent.exists()
    folder.mkdir(parents=True)
    (folder / "mine.txt").write_text("kept")
    assert main(command) == 2
    assert [path.name for path in folder.iterdir()] == ["mine.txt"]


def test_limits_in_degrees_are_warned_of_once_until_the_joint_has_its_own(tmp_path, urdf, capsys):
    urdf.write_text(URDF.replace('lower="-2.5" upper="2.5"', 'lower="-143" upper="143"'))
    folder, words = tmp_path / "cell", "j3: <limit> from -143 to 143 rad looks like degrees; correct it, or set min_deg"
    assert main(["init", str(folder), "--urdf", str(urdf)]) == 0
    assert capsys.readouterr().err.count(words) == 1
    assert main(["plan", str(folder / "cell.toml")]) == 0
    assert capsys.readouterr().out.count(f"lab.urdf: {words}") == 1
    cell = str(folder / "cell.toml")
    assert main(["run", cell, "--duration", "0.1", "--no-figures", "--out", str(tmp_path / "run")]) == 0
    assert capsys.readouterr().err.count(words) == 1
    assert str(json.loads((tmp_path / "run" / "summary.json").read_text())["warnings"]).count(words) == 1
    own = (folder / "cell.toml").read_text().replace("[joints.j3]", "[joints.j3]\nmin_deg = -143\nmax_deg = 143")
    (folder / "cell.toml").write_text(own)
    assert main(["plan", cell]) == 0
    assert words not in capsys.readouterr().out


def test_a_joint_without_range_gets_a_placeholder_and_a_tilt_is_explained(tmp_path, urdf, capsys):
    fixed = 'lower="0.3" upper="0.3"'
    urdf.write_text(URDF.replace('lower="-2.5" upper="2.5"', 'effort="1"', 1).replace('effort="1" effort', "effort"))
    urdf.write_text(urdf.read_text().replace('lower="-2" upper="2" effort="20"', f'{fixed} effort="20"'))
    assert main(["init", str(tmp_path / "cell"), "--urdf", str(urdf)]) == 0
    joints = tomllib.loads((tmp_path / "cell" / "cell.toml").read_text())["joints"]
    for name in ("j3", "j5"):
        assert (joints[name]["min_deg"], joints[name]["max_deg"]) == (-180, 180)
    assert "min_deg" not in joints["j1"]
    assert "tilts the probe" not in capsys.readouterr().err
    few = URDF.replace('type="revolute"', 'type="fixed"', 3).replace('lower="-2" upper="2"', 'lower="-0.2" upper="0.2"')
    urdf.write_text(few)
    main(["init", str(tmp_path / "stiff"), "--urdf", str(urdf)])
    assert "from straight down; it is the best of 400 tried postures" in capsys.readouterr().err


@pytest.fixture
def changed(tmp_path, urdf, capsys):
    """A first scene whose URDF gets another text in the place of one, and that URDF."""

    def change(old, new):
        assert main(["init", str(tmp_path / "cell"), "--urdf", str(urdf)]) == 0
        (copied,) = (tmp_path / "cell").glob("*.urdf")
        copied.write_text(URDF.replace(old, new, 1))
        capsys.readouterr()
        return str(tmp_path / "cell" / "first.toml"), copied

    return change


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ('velocity="3"', 'velocity="1e-9"', "joint j4: expected a velocity in its <limit> of at least 0.000175 rad/s,"
         " got 1e-09; put it right there, or set joints.j4.speed_deg_s"),
        ('velocity="0.5"', 'velocity="1e-9"', "joint rail: expected a velocity in its <limit> of at least 1e-05 m/s,"
         " got 1e-09; put it right there, or set joints.rail.speed_mm_s"),
        ('lower="-2" upper="2"', 'lower="0" upper="0"', "joint j2: expected lower below upper in its <limit>, got 0"
         " and 0; put it right there, or set joints.j2.min_deg and max_deg"),
    ],
)  # fmt: skip
def test_a_limit_of_nothing_is_refused_with_file_joint_and_key(changed, capsys, old, new, what):
    scene, copied = changed(old, new)
    assert main(["plan", scene]) == 2
    assert f"{copied}: {what}" in capsys.readouterr().err


def test_a_range_of_the_section_replaces_that_of_the_urdf(changed, capsys):
    scene, _ = changed('lower="-2" upper="2"', 'lower="0" upper="0"')
    main(["plan", scene, "--set", "joints.j2.min_deg=-114", "--set", "joints.j2.max_deg=114"])
    assert "expected lower below upper" not in capsys.readouterr().err


def test_a_speed_limit_of_the_section_replaces_that_of_the_urdf_however_low(changed, capsys):
    scene, _ = changed('velocity="2"', 'velocity="1e-9"')
    assert main(["plan", scene, "--set", "joints.j1.speed_deg_s=1e-7"]) == 2
    assert "joint 2 would need" in (said := capsys.readouterr().err)
    assert "allowed 5e-08" in said, "half of it by limits.joint_speed_share"


def chain_of(*joints, after=""):
    """A URDF of joints in a row, each as (type, axis, origin, attributes of its limit or None)."""
    links = "".join(f'<link name="l{i}"/>' for i in range(len(joints) + 1))
    rows = [
        f'<joint name="j{i}" type="{kind}"><parent link="l{i - 1}"/><child link="l{i}"/><origin xyz="{origin}"/>'
        f'<axis xyz="{axis}"/>{"" if limit is None else f"<limit {limit}/>"}</joint>'
        for i, (kind, axis, origin, limit) in enumerate(joints, 1)
    ]
    return f'<robot name="row">{links}{"".join(rows)}{after}</robot>'


def fixed(name, parent, origin="0 0 0", rpy="0 0 0"):
    joint = f'<joint name="to_{name}" type="fixed"><parent link="{parent}"/><child link="{name}"/>'
    return f'<link name="{name}"/>{joint}<origin xyz="{origin}" rpy="{rpy}"/></joint>'


TURNS = 'lower="-1.57" upper="1.57" effort="20" velocity="2"'
ARM = (
    ("revolute", "0 0 1", "0 0 0.26", TURNS),
    ("revolute", "0 1 0", "0 0 0", TURNS),
    ("revolute", "0 1 0", "0.05 0 0.28", TURNS),
    ("revolute", "0 1 0", "0.3 0 0", TURNS),
)
ROLL = ("revolute", "1 0 0", "0.1 0 0", TURNS)


def begun(tmp_path, text, *words):
    """What init answers to a URDF, and the cell that it wrote."""
    tmp_path.mkdir(exist_ok=True)
    (tmp_path / "row.urdf").write_text(text)
    status = main(["init", str(tmp_path / "cell"), "--urdf", str(tmp_path / "row.urdf"), *words])
    cell = tmp_path / "cell" / "cell.toml"
    return status, tomllib.loads(cell.read_text()) if cell.exists() else None


GRIPPER = (
    '<link name="finger"/><joint name="grip" type="prismatic"><parent link="l4"/><child link="finger"/>'
    '<limit lower="0" upper="0.04" effort="1" velocity="1"/><mimic joint="j1"/></joint>'
)


def test_the_only_tip_that_drives_can_move_is_taken(tmp_path):
    """A frame that stands still, and a finger that mimics another joint, are no tips."""
    status, cell = begun(
        tmp_path, chain_of(*ARM, after=fixed("tool0", "l4", "0.05 0 0") + fixed("base_frame", "l0") + GRIPPER)
    )
    assert status == 0 and list(cell["joints"]) == ["j1", "j2", "j3", "j4"]


def test_of_several_tips_only_those_that_can_be_taken_are_listed(tmp_path, capsys):
    text = chain_of(*ARM, after=fixed("left", "l4") + fixed("right", "l4") + GRIPPER + fixed("still", "l0"))
    assert begun(tmp_path, text)[0] == 2
    assert capsys.readouterr().err.rstrip().endswith("one of left, right")
    assert begun(tmp_path, text, "--tip", "right")[0] == 0


def test_five_axes_with_the_roll_last_scan_as_without_it(tmp_path, capsys):
    tip = fixed("tool0", "l5", "0.02 0 0", "0 1.5708 0")
    status, _ = begun(tmp_path, chain_of(*ARM, ROLL, after=tip))
    assert status == 0 and "freely" not in capsys.readouterr().out
    assert main(["plan", str(tmp_path / "cell" / "first.toml")]) == 0
    assert "joint 5 only turns the probe about its pole" in capsys.readouterr().out
    q = resolve(load_scene(tmp_path / "cell" / "first.toml")).task.arm.q_start
    out = tmp_path / "run"
    words = ["--bus", "direct", "--duration", "0.5", "--no-figures", "--out", str(out), "--json"]
    assert main(["run", str(tmp_path / "cell" / "first.toml"), *words]) == 0
    assert json.loads(capsys.readouterr().out)["contact"]["contact_fraction"] == 1.0
    assert np.nanmax(np.abs(np.load(out / "log.npz")["q_target_rad"][:, 4] - q[4])) < 1e-3


@pytest.mark.parametrize(
    ("origin", "rpy", "turn", "axis"),
    [
        ("0.05 0 0", "0 0 0", [0, 90, 0], "x"),
        ("0.05 0 0", "0 1.5708 0", [0, 0, 0], "z"),
        ("0.05 0 0", "0 0 1.5708", [90, 0, 0], "-y"),
        ("0.05 0 0.04", "0 0 0", [0, 0, 0], "z"),
    ],
)
def test_the_probe_prolongs_the_arm_and_the_cell_says_along_which_axis(tmp_path, origin, rpy, turn, axis):
    status, cell = begun(tmp_path, chain_of(*ARM, after=fixed("tip", "l4", origin, rpy)))
    assert status == 0 and cell["arm"]["flange_deg"] == turn
    assert f"which is now the tip's {axis}\n" in (tmp_path / "cell" / "cell.toml").read_text()


def test_millimetres_and_passive_joints_are_named(tmp_path, capsys):
    tall = [(kind, axis, " ".join(str(1000 * float(x)) for x in xyz.split()), limit) for kind, axis, xyz, limit in ARM]
    assert begun(tmp_path / "a", chain_of(*tall[:2]))[0] == 0
    assert "add up to 260 m, which looks like millimetres; a URDF is in metres" in capsys.readouterr().err
    slides = ("prismatic", "1 0 0", "0 0 0.3", 'lower="0" upper="500" effort="50" velocity="2"')
    assert begun(tmp_path / "b", chain_of(slides))[0] == 2
    assert "j1: a joint slides 100 m at most; correct its <limit>" in capsys.readouterr().err
    delta = chain_of(ARM[1], ("continuous", "0 1 0", "0.2 0 0", None), ("continuous", "0 1 0", "0 0 -0.4", None))
    assert begun(tmp_path / "d", delta)[0] == 0
    said = capsys.readouterr()
    assert "j2, j3: no velocity in the <limit>, as of passive joints" in said.err and "freely" in said.out


def test_a_packaged_eds_is_taken_by_its_name(tmp_path):
    status, cell = begun(tmp_path, chain_of(*ARM), "--eds", "puma260_joint")
    assert status == 0 and cell["arm"]["eds"] == "puma260_joint.eds"
    assert (tmp_path / "cell" / "puma260_joint.eds").read_bytes() == eds_path("puma260_joint").read_bytes()
