"""Study `surfaces`: its methods on surfaces that are known, its shapes and paths, its words, and a short run."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cli import main
from canprobe.lab.studies import exploration, surfaces
from canprobe.lab.studies.drawn_shapes import KINDS, DrawnShape, TrueGround, drawn, form_heights_mm, object_of, scene_of
from canprobe.lab.studies.surface_methods import METHODS, FoundSurface
from canprobe.lab.studies.surfaces import COLUMNS, SurfaceCase, findings, measure, rows_of, score
from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.objects import Sphere

RADIUS = 0.05
POLE = np.eye(4)
POLE[2, 3] = RADIUS
BALL = Sphere(POLE, RADIUS)
"""Its middle is the origin."""
TILTED = np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
"""Its columns: the rectangle's axes, and its normal."""


def ground():
    approach = SimpleNamespace(axes=TILTED.T, normal=TILTED[:, 2])
    return TrueGround.of(BALL, approach, RADIUS * TILTED[:, 2])


def on_ball(noise=0.0, seed=0):
    """Contacts on the rectangle, 1 mm apart; noise of heights, m, and of normals, 20 times as many rad."""
    rng = np.random.default_rng(seed)
    x, y = (c.ravel() for c in np.meshgrid(np.arange(-16e-3, 16.1e-3, 1e-3), np.arange(-11e-3, 11.1e-3, 1e-3)))
    n = np.stack([x, y, np.sqrt(RADIUS**2 - x**2 - y**2)], axis=1) @ TILTED.T / RADIUS
    p = RADIUS * n + noise * rng.normal(size=(len(n), 1)) * n
    m = n + 20 * noise * rng.normal(size=n.shape)
    m /= np.linalg.norm(m, axis=1)[:, None]
    sigma = max(noise, 1e-7)
    return [
        ContactSample(0.005 * i, a, b, np.eye(4), np.zeros(3), 2.0, 20 * sigma / 28, sigma_height=sigma)
        for i, (a, b) in enumerate(zip(p, m, strict=True))
    ]


def seen(name, setting, samples, points):
    find, *_ = METHODS[name]
    return find(samples, resolve(load_scene("cylinder")).task, setting, points)


@pytest.mark.parametrize(("name", "setting"), [("quadrics", 3.0), ("spline", 0.0), ("process", 400)])
def test_a_ball_without_noise_is_found_by_every_method(name, setting):
    """A tilted ball: signs, axes and scales of heights, normals and curvature."""
    truth = ground()
    found = score(seen(name, setting, on_ball(), truth.points), truth)
    assert found["known"] == 1.0
    assert found["height_um"] < 0.5
    assert found["normal_mrad"] < 0.3
    assert found["curvature_per_m"] < 1.0
    lifted = score(
        seen(name, setting, on_ball(), truth.points)._replace(height=np.full(len(truth.points), 1e-4)), truth
    )
    assert lifted["height_um"] == pytest.approx(100.0)


@pytest.mark.parametrize(("name", "setting"), [("quadrics", 4.0), ("process", 400)])
def test_a_method_has_the_error_that_it_states(name, setting):
    truth = ground()
    inside = [score(seen(name, setting, on_ball(2e-5, seed), truth.points), truth)["coverage"] for seed in range(3)]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.06)


def test_a_surface_ends_where_nothing_was_touched():
    truth = ground()
    half = [sample for sample in on_ball() if sample.p_base @ TILTED[:, 0] < 0.0]
    found = score(seen("quadrics", 4.0, half, truth.points), truth)
    assert 0.4 < found["known"] < 0.8
    missing = np.full(len(truth.points), math.nan)
    nothing = FoundSurface(missing, missing[:, None] + np.zeros(3), missing[:, None, None] + np.zeros((3, 3)), missing)
    assert score(nothing, truth) == dict.fromkeys(found) | {"known": 0.0}
    assert [errors.max() for errors in truth.errors(nothing)] == [1e-3, 0.1, 20.0]


def test_shapes_are_repeated_and_a_draw_is_like_no_other(tmp_path):
    assert len(drawn(7)) == len(KINDS) == 12
    for one, other in zip(drawn(7), drawn(8), strict=True):
        assert scene_of(one, tmp_path, 1.0).seed != scene_of(other, tmp_path, 1.0).seed
        keys = object_of(one, tmp_path)
        assert keys == object_of(one, tmp_path)
        assert keys["kind"] == "heights" or keys != object_of(other, tmp_path)
    np.testing.assert_array_equal(form_heights_mm("groove", 2), form_heights_mm("groove", 2))
    assert np.abs(form_heights_mm("groove", 2) - form_heights_mm("groove", 5)).max() > 0.3


@pytest.mark.parametrize("name", exploration.STRATEGIES[1:])
def test_fixed_paths_begin_in_the_middle_and_are_closed(name):
    path = exploration.fixed(name)
    assert [*path.point(0.0), *path.point(2.0 * math.pi)] == pytest.approx([0.0] * 4, abs=1e-9)
    x, y = np.array([path.point(phase) for phase in np.linspace(0.0, 2.0 * math.pi, 400)]).T
    assert np.abs(x).max() <= 15.01e-3
    assert np.abs(y).max() <= 10.01e-3


def test_an_error_counts_as_reached_where_it_stays_below():
    scan = {"path": [0.01, 0.02, 0.03, 0.04], "height": [1.0, 1e-5, 1.0, 1e-5]}
    assert exploration.path_to(scan, "height", 2e-5) == 0.04
    assert exploration.path_to(scan, "height", 1e-6) is None
    assert exploration.path_to(scan, "height", 2.0) == 0.01


def test_exploration_is_compared_with_the_best_of_the_others():
    def scans(path):
        one = {"path": [path], "seconds": [1.0], "force_percent": 3.0, "contact": 1.0, "stopped": None}
        return [one | {key: [0.0] for key in exploration.LIMITS}] * 3

    each = {"explore": scans(0.06), "weave 12 mm": scans(0.12), "raster 8 mm": scans(0.1)}
    rows = [exploration.row_of(name, found) for name, found in each.items()]
    assert [row["height_mm"] for row in rows] == pytest.approx([60.0, 120.0, 100.0])
    said = exploration.findings(rows, each, ["sphere", "cylinder", "groove"])
    assert "needs 0.60 (0.60 to 0.60)" in said[1]
    assert "raster 8 mm" in said[1] and "no shape" in said[1]


def test_the_map_is_compared_with_the_best_of_the_others_shape_by_shape():
    scores = dict.fromkeys(COLUMNS[3:], 1.0)
    names = [{"method": name, "setting": 4.0, "unit": "mm radius"} for name in ("map", "quadrics", "process")]
    each = [
        [
            names[0] | scores,
            names[1] | scores | {"height_um": 2.0 + k},
            names[2] | scores | {"height_um": 9.0, "nll": None},
        ]
        for k in range(2)
    ]
    rows = rows_of(each)
    assert (rows[1]["height_um"], rows[1]["height_um_low"], rows[1]["height_um_high"]) == (2.5, 2.0, 3.0)
    assert math.isnan(rows[2]["nll"])
    said = findings(rows)
    assert "height: map 1 in 1.00 s; best of the others quadrics (4 mm radius) 2.5 in 1.00 s; difference 1.5" in said[1]


def test_a_strategy_that_a_plan_refuses_says_why():
    assert "the path leaves the object" in measure(SurfaceCase(DrawnShape(44, 10), "raster 8 mm", 1.0))["refused"]


@pytest.mark.slow(reason="a whole study in its quick form")
def test_the_quick_study_runs_from_the_command_line(tmp_path, capsys):
    assert main(["study", "surfaces", "--quick", "--out", str(tmp_path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {row["method"] for row in document["rows"]} == set(METHODS)
    assert all(row["height_um"] < 100 and row["cpu_s"] > 0 for row in document["rows"])
    (paths,) = document["more"]
    assert [row["strategy"] for row in paths["rows"]] == list(surfaces.QUICK_STRATEGIES)
    assert all(row["contact"] == 1.0 and row["stopped"] == 0 for row in paths["rows"])
    assert all((tmp_path / name).stat().st_size > 10_000 for name in ("surfaces.png", "exploration.png"))
