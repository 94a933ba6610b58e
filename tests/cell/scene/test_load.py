"""The strict loader: what loads, what is refused and with which words, and the way back to TOML."""

import dataclasses
import functools
import math
import random
import tomllib
import typing

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import canprobe
from canprobe.cell.scene.hardware import ArmSettings, BringUpSettings, JointSettings
from canprobe.cell.scene.load import dump_scene, load_scene, packaged, parse_scene
from canprobe.cell.scene.model import (
    LimitSettings,
    ProbeSettings,
    Scene,
    SceneInfo,
    SensorSettings,
    ShapeSettings,
    TaskSettings,
)
from canprobe.errors import CanprobeError, SceneError

SCAN = """
[scene]
name = "test"
[arm]
[sensor]
[object]
kind = "plane"
[task]
kind = "scan"
"""


UNSYMMETRIC = "[[1, 2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 0]]"


def problems_of(text):
    with pytest.raises(SceneError) as caught:
        parse_scene(text, file="file.toml")
    return list(caught.value.problems)


def with_line(section, line):
    """SCAN with one more line in a section, which is added where it is missing."""
    head = f"[{section}]\n"
    return SCAN.replace(head, f"{head}{line}\n") if head in SCAN else f"{SCAN}{head}{line}\n"


def test_minimal_scan_gets_every_default():
    scene = parse_scene(SCAN)
    assert scene.name == "test"
    assert scene.seed == 0
    assert (scene.bus.interface, scene.bus.channel, scene.bus.bitrate) == ("lockstep", "can0", 1_000_000)
    assert scene.cycle.rate_hz == 400
    assert scene.arm == ArmSettings()
    assert scene.sensor == SensorSettings()
    assert scene.probe == ProbeSettings()
    assert scene.shape == ShapeSettings()
    assert scene.limits == LimitSettings(force_max_n=5)
    assert scene.servo is not None
    assert scene.plant is not None
    assert scene.emulated_node_ids == (1, 2, 3, 4, 5, 6, 16)
    assert parse_scene(with_line("arm", "emulated = false")).emulated_node_ids == (16,)


@pytest.mark.parametrize(
    ("kind", "sections", "absent"),
    [
        ("press", "[arm]\n[sensor]\n[object]\nkind = 'plane'\n", {"shape"}),
        ("calibrate", "[arm]\n[sensor]\n[object]\nkind = 'sphere'\nradius_mm = 25\n", {"shape", "servo"}),
        ("listen", "[sensor]\n", {"arm", "shape", "servo", "object"}),
        ("free", "[arm]\n", {"sensor", "wire", "object", "shape", "servo"}),
    ],
)
def test_sections_that_a_task_does_not_need_are_absent(kind, sections, absent):
    scene = parse_scene(f"[scene]\nname = 'test'\n{sections}[task]\nkind = '{kind}'\n")
    assert {field.name for field in dataclasses.fields(scene) if getattr(scene, field.name) is None} == {
        *absent,
        "bridge",
        "carrier",
        "keep_out",
    }


@pytest.mark.parametrize(
    ("section", "line", "path", "words"),
    [
        ("task", "forse_n = 2", "task.forse_n", ("unknown key", "did you mean force_n?")),
        ("task", "force_n = '2'", "task.force_n", ("a number above 0 up to 20", 'got "2"')),
        ("task", "force_n = 0", "task.force_n", ("above 0", "got 0")),
        ("task", "force_n = nan", "task.force_n", ("got nan",)),
        ("task", "force_n = 6", "task.force_n", ("less than limits.force_max_n = 5", "got 6")),
        ("task", "duration_s = inf", "task.duration_s", ("got inf",)),
        ("task", "approach_mm_s = 5", "task.approach_mm_s", ("up to 4", "got 5")),
        ("task", "start_mm = [1, 2]", "task.start_mm", ("a list of 3 numbers", "got [1, 2]")),
        ("task", "approach_normal = [0, 0, 0]", "task.approach_normal", ("not all zero",)),
        ("task", "approach_normal = [1, 0, 0]", "task.heading_deg", ("across task.approach_normal",)),
        ("task", "strategy = 'wave'", "task.strategy", ("weave, straight, circle", "did you mean weave?")),
        ("task", "rolling_share = 1.5", "task.rolling_share", ("from 0 to 1", "got 1.5")),
        ("task", "swing_period_s = 2", "task.swing_period_s", ('only with kind = "free"', 'kind = "scan"')),
        ("scene", "seed = 1.5", "scene.seed", ("an integer", "got 1.5")),
        ("scene", "seed = -1", "scene.seed", ("from 0", "got -1")),
        ("bus", "channel = ''", "bus.channel", ('got ""',)),
        ("cycle", "rate_hz = 0", "cycle.rate_hz", ("from 1 to 2000",)),
        ("limits", "joint_speed_share = 1e-9", "limits.joint_speed_share", ("from 0.001 to 1, got 1e-09",)),
        ("cycle", "compute_us = 2500", "cycle.compute_us", ("less than the 2500 µs of a cycle", "got 2500")),
        ("arm", "emulated = 1", "arm.emulated", ("true or false", "got 1")),
        ("sensor", "node_id = 6", "sensor.node_id", ("that no joint has", "got 6, as joints.joint_6")),
        ("sensor", "node_id = 127", "sensor.node_id", ("from 1 to 126", "got 127")),
        ("sensor", "rate_hz = 500", "sensor.rate_hz", ("at most cycle.rate_hz = 400", "got 500")),
        ("sensor", "emulated = false", "sensor.emulated", ("a real sensor cannot measure",)),
        ("shape", "also = ['recursive']", "shape.also", ("besides the main one",)),
        ("shape", "also = ['ml', 'ml']", "shape.also", ("all different",)),
        ("object", "radius_mm = 3", "object.radius_mm", ("only with kind", 'kind = "plane"')),
        ("plant", "fidelity = 'exact'", "plant.fidelity", ("one of ideal, dynamic",)),
        ("probes", "radius_mm = 3", "probes", ("unknown section", "did you mean probe?")),
    ],
)
def test_one_wrong_line_is_one_problem(section, line, path, words):
    text = with_line(section, line)
    (problem,) = problems_of(text)
    assert problem.startswith(f"file.toml: {path}: ")
    assert all(word in problem for word in words), problem


@pytest.mark.parametrize(
    ("text", "path", "word"),
    [
        (SCAN.replace('[object]\nkind = "plane"\n', ""), "object", "touches nothing without an [object]"),
        (SCAN.replace('name = "test"\n', ""), "scene.name", "missing"),
        (SCAN.replace('kind = "scan"\n', ""), "task.kind", "one of scan, press, calibrate, listen, free"),
        (SCAN.replace('"plane"', '"sphere"'), "object.radius_mm", 'kind = "sphere" needs it'),
        (SCAN.replace('"plane"', '"saddle"\nradius_x_mm = 60'), "object.radius_y_mm", "needs it"),
        (SCAN.replace('"plane"', '"saddle"\nradius_x_mm = 60\nradius_y_mm = 80'), "object.radius_y_mm", "opposite"),
        (SCAN.replace('"plane"', '"quadric"'), "object.matrix", "needs it"),
        (SCAN.replace('"plane"', f'"quadric"\nmatrix = {UNSYMMETRIC}'), "object.matrix", "symmetric"),
        (SCAN.replace('"scan"', '"press"') + "[shape]\n", "shape", "one touch without motion shows no shape"),
        ("scene = 3\n" + SCAN.replace('[scene]\nname = "test"\n', ""), "scene", "expected a section"),
    ],
)
def test_what_does_not_go_together(text, path, word):
    (problem,) = problems_of(text)
    assert problem.startswith(f"file.toml: {path}: ")
    assert word in problem


def test_all_problems_come_at_once():
    text = SCAN.replace("[arm]", "[arm]\nemulated = 3\nspeed = 1").replace("[task]", "[task]\nforce_n = -1\n")
    paths = [problem.split(": ")[1] for problem in problems_of(text + "[whatever]\n")]
    assert sorted(paths) == ["arm.emulated", "arm.speed", "task.force_n", "whatever"]


def test_toml_error_names_file_and_line():
    (problem,) = problems_of("[scene]\nname = \n")
    assert problem.startswith("file.toml: not valid TOML: ")
    assert "line 2" in problem


def test_unknown_scene_suggests_and_lists():
    with pytest.raises(SceneError) as caught:
        load_scene("cilinder")
    (problem,) = caught.value.problems
    assert "did you mean cylinder?" in problem
    assert all(name in problem for name, _ in packaged("scene"))


def test_missing_file_and_binary_file(tmp_path):
    with pytest.raises(SceneError, match="cannot be read"):
        load_scene(tmp_path / "none.toml")
    with pytest.raises(SceneError, match="cannot be read"):
        load_scene(f"{tmp_path}/")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(SceneError, match="not UTF-8"):
        load_scene(tmp_path / "binary.toml")


def test_eds_beside_the_scene_is_found_from_anywhere(tmp_path, monkeypatch):
    (tmp_path / "mine.eds").touch()
    (tmp_path / "mine.toml").write_text(with_line("arm", 'eds = "mine.eds"'))
    monkeypatch.chdir(tmp_path.parent)
    scene = load_scene(tmp_path / "mine.toml")
    assert scene.arm.eds == str(tmp_path / "mine.eds")


@pytest.mark.parametrize("name", [name for name, _ in packaged("scene")])
def test_packaged_scenes_survive_the_way_back_and_carry_the_limits_of_hardware(name):
    """No limit is widened for a machine that is slow: who runs on such a one says so."""
    scene = load_scene(name)
    assert scene.name == name and scene.title
    assert parse_scene(dump_scene(scene)) == scene
    assert scene.arm is None or scene.arm.missed_syncs == 5
    assert (scene.limits, scene.bring_up) == (LimitSettings(), BringUpSettings())
    assert scene.limits.late_cycles_max_percent == 10


@settings(max_examples=10)
@given(title=st.text(), seed=st.integers(0, 2**63 - 1), force=st.floats(0.001, 4.9), x=st.floats(-1e3, 1e3))
def test_any_values_survive_the_way_back(title, seed, force, x):
    scene = parse_scene(SCAN)
    task = dataclasses.replace(scene.task, force_n=force, start_mm=(x, -x, math.pi * x))
    scene = dataclasses.replace(scene, scene=SceneInfo("test", title, seed), task=task)
    text = dump_scene(scene)
    assert parse_scene(text) == scene
    assert tomllib.loads(text)["scene"]["title"] == title


def _class_of(hint):
    return next(iter(typing.get_args(hint)), hint)


def test_defaults_pass_their_own_checks():
    joints = {"one": JointSettings(min_deg=-90, max_deg=90, speed_deg_s=30, counts_per_turn=4096)}
    scene = Scene(SceneInfo("test"), TaskSettings("free"), arm=ArmSettings(), joints=joints, plant=None)
    read = parse_scene(dump_scene(scene))
    assert (read.arm, read.joints) == (scene.arm, joints)


def test_a_byte_order_mark_and_windows_line_ends_are_read(tmp_path):
    path = tmp_path / "notepad.toml"
    path.write_bytes(b"\xef\xbb\xbf" + SCAN.replace("\n", "\r\n").encode())
    assert load_scene(path) == parse_scene(SCAN)


@pytest.mark.parametrize(
    ("number", "told"),
    [("1" + "0" * 400, "task.duration_s: expected a number above 0 up to"), ("9" * 5000, "not valid TOML: ")],
)
def test_integers_that_no_float_holds(number, told):
    (problem,) = problems_of(with_line("task", f"duration_s = {number}"))
    assert problem.startswith(f"file.toml: {told}")


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("joints.joint_3.a_mm", 1e308, "expected a number, at most 1e+20 in size, got 1e+308"),
        ("joints.joint_6.zero_counts", -(10**30), f"expected an integer, at most 1e+20 in size, got {-(10**30)}"),
        ("joints.joint_4.gear", 5e-324, "expected a number above 0 up to 100000, got 5e-324"),
        ("object.position_mm", [0.0, 1e308, 0.0], "expected a list of 3 numbers, at most 1e+20 in size, got"),
        ("joints.joint_5.alpha_deg", functools.reduce(lambda inner, _: [inner], range(40), []), "expected tables and"),
    ],
)
def test_numbers_and_depths_that_no_scene_has(key, value, told):
    with pytest.raises(SceneError) as caught:
        load_scene("cylinder", {key: value})
    assert caught.value.problems[0].startswith(f"cylinder.toml as changed: {key}: {told}")


ODD = (
    math.nan, math.inf, -1, 0, -0.0, 1e308, -1e308, 1e-308, 5e-324, "", "x", [], {}, True, 10**30, 10**400, -(2**63),
    "ü" * 300, "\0", "a\nb", "nan", "/dev/zero", "/tmp", [0, 0, 0], [math.nan] * 3, [1e308] * 3, ["x"] * 6, [[]],
    {"a": 1}, {"x": {"y": {}}}, None,
)  # fmt: skip


def keys_of(scene):
    """Every key of a scene, those of the tables within tables too, and some that it does not have."""
    for section, hint in typing.get_type_hints(Scene).items():
        value = getattr(scene, section)
        if section == "postures":
            yield from (section, f"{section}.ready")
            continue
        tables = {f"{section}.{name}": one for name, one in value.items()} if section == "joints" else {section: value}
        for path, table in tables.items():
            kind = type(table) if table is not None else _class_of(hint)
            yield from (path, f"{path}.new", *(f"{path}.{field.name}" for field in dataclasses.fields(kind)))


@pytest.mark.parametrize("name", ["cylinder", "listen"])
def test_odd_values_of_any_key_are_a_plan_or_an_error_that_names_the_key(name):
    pairs = [(key, value) for key in keys_of(load_scene(name)) for value in ODD]
    for key, value in random.Random(0).sample(pairs, 12):
        try:
            canprobe.plan(load_scene(name, {key: value}))
        except CanprobeError as error:
            named = f"{value}: cannot be read" in str(error) or any(word in str(error) for word in key.split("."))
            assert named, (key, value, str(error))


@pytest.mark.parametrize(
    ("key", "path"),
    [
        ("arm.urdf", "\0"),
        ("arm.eds", "\0"),
        ("joints.joint_2.eds", "ü" * 300),
        ("sensor.eds", "/tmp"),
        ("sensor.array", "\0"),
        ("sensor.array", "/tmp"),
        ("sensor.calibration", "ü" * 300),
    ],
)
def test_a_path_that_no_file_has_is_named_or_its_key_is(key, path):
    with pytest.raises(CanprobeError) as caught:
        canprobe.plan(load_scene("cylinder", {key: path}))
    assert path in str(caught.value) or key.rpartition(".")[2] in str(caught.value)


def test_lists_nested_beyond_the_parser():
    (problem,) = problems_of(f"x = {'[' * 5000}{']' * 5000}")
    assert problem == "file.toml: expected tables and lists of at most 32 levels, got more of them"
