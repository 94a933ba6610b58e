"""What callers put in the place of a scene's values: as strict as the file, and open to numpy's numbers and paths."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

import canprobe
from canprobe.cell.scene.load import load_scene, parse_scene
from canprobe.cell.session.target import Target
from canprobe.errors import SceneError, UsageError

PRESS = load_scene("press")


@pytest.mark.parametrize(
    ("overrides", "told"),
    [
        ({"scene.seed": 1.5}, r"changed: scene\.seed: expected an integer from 0 to \d+, got 1\.5"),
        ({"task.force_N": 3}, r"task\.force_N: unknown key; did you mean force_n\?"),
        ({"object": {"kind": "ellipsoid", "semi_axes_mm": 9}}, r"object\.semi_axes_mm: unknown key\n"),
        ({"force_n": 3}, r"force_n: unknown section; did you mean task\.force_n\?"),
        ({"rate_hz": 3}, r"did you mean cycle\.rate_hz or sensor\.rate_hz\?"),
        ({"task.force_n.x": 3}, r"task\.force_n: expected a number above 0 .* got \{x = 3\}"),
        ({"bus.channel": "a b"}, r'bus\.channel: expected text without spaces, in ASCII, got "a b"'),
        ({"bus.interface": None, "bus.bitrate": 0}, r"bus\.bitrate: expected an integer from 10000"),
        ({"task.": 3}, r"overrides: expected a key such as task\.force_n, got 'task\.'"),
        ("gantry", r"overrides: expected values by key such as .* got 'gantry'"),
    ],
)
def test_a_value_that_no_file_could_have(overrides, told):
    with pytest.raises(UsageError, match=told):
        load_scene("press", overrides)


def test_a_changed_scene_is_that_of_a_changed_file(tmp_path):
    wanted = {"task.force_n": 3, "object.radius_mm": 50, "shape.also": (), "shape.method": "ml"}
    text = (Path(canprobe.__file__).parent / "scenes/cylinder.toml").read_text()
    for old, new in (("force_n = 2", "force_n = 3"), ("radius_mm = 36", "radius_mm = 50"), ('"recursive"', '"ml"')):
        assert old in text
        text = text.replace(old, new, 1)
    (tmp_path / "mine.toml").write_text(text.replace('also = ["ml", "chen1996"]', "also = []"))
    by_file = load_scene(tmp_path / "mine.toml")
    told = {"scene.title": by_file.title}
    assert load_scene("cylinder", wanted | told) == load_scene(load_scene("cylinder"), wanted | told) == by_file
    assert load_scene("cylinder", {"cell": "puma560"}).cell.name == "puma560"


def test_the_title_says_that_object_or_task_were_changed():
    title = PRESS.title
    assert load_scene(PRESS, {"scene.seed": 3, "task.duration_s": 1}).title == title
    once = load_scene("press", {"task.force_n": 1})
    assert once.title == load_scene(once, {"task.force_n": 3}).title == f"{title} (changed)"


def test_none_takes_a_key_or_a_section_away_and_a_table_takes_the_place_of_one():
    assert load_scene("cylinder", {"task.force_n": None}).task.force_n == 2.0
    ball = {"kind": "sphere", "radius_mm": np.float64(40), "position_mm": np.array([-120, -122.5, 374])}
    for scene in ("cylinder", load_scene("cylinder")):
        changed = load_scene(scene, {"object": ball}).object
        assert (changed.kind, changed.radius_mm, changed.position_mm) == ("sphere", 40.0, (-120.0, -122.5, 374.0))
        with pytest.raises(SceneError, match="object: missing"):
            load_scene(scene, {"object": None})


def test_another_cell_cannot_come_into_a_scene_that_has_its_cell(tmp_path):
    with pytest.raises(SceneError, match='press: cell: the scene describes its cell itself, got "gantry"'):
        load_scene(PRESS, {"cell": "gantry"})


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"channel": {"can0": ""}}, r"bus\.channel: "),
        ({"channel": {"can1": "vcan1"}}, "channel: the scene has no channel can1, only can0"),
        ({"bitrate": 0}, r"bus\.bitrate: expected an integer from 10000"),
        ({"bus": 3}, r"bus\.interface: expected text"),
    ],
)
def test_a_bus_that_no_file_could_have(values, told):
    with pytest.raises(UsageError, match=told):
        Target.over(PRESS, **values)


def test_numbers_of_numpy_become_those_of_python():
    given = {"scene.seed": np.int64(3), "task.duration_s": np.float32(0.5), "bus.bitrate": np.int32(500_000)}
    scene = load_scene(PRESS, given)
    values = [scene.seed, scene.task.duration_s, scene.bus.bitrate]
    assert [type(value) for value in values] == [int, float, int]
    assert json.loads(json.dumps(values)) == [3, 0.5, 500_000]


def test_what_is_not_given_stays():
    assert load_scene(PRESS) is PRESS
    assert Target.over(PRESS).applied_to(PRESS) == PRESS == load_scene(PRESS, {"scene.seed": PRESS.seed})


@pytest.mark.parametrize("call", [canprobe.plan, canprobe.run, canprobe.open_cell])
def test_what_is_no_scene(call):
    with pytest.raises(UsageError, match="scene: expected a packaged name, the path of a TOML file or a Scene, got 3"):
        call(3)
    with pytest.raises(SceneError, match=r"pres: no such scene, cell or file; did you mean press\?"):
        call("pres")
    with pytest.raises(SceneError, match=r"did you mean force_n\?"):
        call("press", {"task.force": 3})


TAXELS = [[x, y, 0.0] for x in (0.0, 4.0) for y in (0.0, 4.0)]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (f"positions_mm = {TAXELS[:3] + TAXELS[:1]}", r"positions_mm: expected a place for each taxel, got .* 1 and 4"),
        (f"positions_mm = {[[x / 1e3 for x in t] for t in TAXELS]}", r"positions_mm: .* are they in metres\?"),
        (f"positions_mm = {TAXELS}\nnormals = {[[0.1, 0, -1]] * 4}", "normals: expected outward normals"),
        ('mode = "window"', 'window: .* the smallest window has 4: set sensor.mode = "image"'),
    ],
)
def test_an_array_in_another_unit_or_inside_out_is_refused(keys, message):
    text = '[scene]\nname = "mine"\n[task]\nkind = "press"\n[sensor]\nrows = 2\ncolumns = 2\npitch_mm = 4\n'
    with pytest.raises(SceneError, match=rf"sensor\.{message}"):
        parse_scene(text + keys + '\n[object]\nkind = "plane"\n')


def test_counts_that_do_not_fit_the_field_are_refused():
    wire = '[wire]\nkind = "frames"\nids = ["480h"]\nframes = ["aa bb cc dd"]\nsampling = "free"\nunloaded_counts = 1\n'
    text = '[scene]\nname = "mine"\n[task]\nkind = "press"\n[object]\nkind = "plane"\n'
    text += '[sensor]\nrows = 2\ncolumns = 2\nmode = "image"\n'
    with pytest.raises(SceneError, match=r"wire\.full_scale_counts: expected 0 to 255 in 8 unsigned bits .* got 256"):
        parse_scene(f"{text}{wire}full_scale_counts = 256\n")


@pytest.mark.parametrize(
    ("name", "value"), [("overrides", 3.0), ("out", []), ("out", b"runs"), ("observers", math.inf), ("bridge", 1j)]
)
def test_an_argument_of_another_kind_is_refused_before_anything_is_started(name, value):
    for call in (canprobe.run, canprobe.open_cell):
        with pytest.raises(UsageError, match=f"^{name}: expected .*, got "):
            call("free", **{name: value})
