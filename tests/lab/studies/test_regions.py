"""Study `regions`: scores of exact answers, random scenes, draws, comparisons, and scans with the whole sensor on."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.resolve import resolve
from canprobe.cli import main
from canprobe.errors import PlanError, UsageError
from canprobe.lab.studies.random_scenes import CELLS, KINDS, SceneSeed, random_scene
from canprobe.lab.studies.region_scores import ScoredScan, behind_jump, measure, scored
from canprobe.lab.studies.regions import DRAWS_PER_SCENE, compared, earlier_rows, findings, row_of, rows_of, scan_all

ROW = 400
TRUTH = {
    "kappa_per_m": np.tile([30.0, -10.0], (2000, 1)),
    "direction1": np.tile([0.6, 0.8, 0.0], (2000, 1)),
    "direction2": np.tile([-0.8, 0.6, 0.0], (2000, 1)),
}


def scan(scores, kind="sphere", *, late=125, number=0, ended="", behind=()):
    return ScoredScan(
        SceneSeed(2, kind, number).value(), kind, kind, "puma260", "calibrated", "weave", 25.0, 2.0, 100.0, 0.0, ended,
        late, np.reshape(scores, (-1, 5)), len(behind), np.reshape(behind, (-1, 5)),
    )  # fmt: skip


def answers(size, stated=1.0, count=100, seed=2):
    """Scores of errors of one size; 1 is what is stated."""
    e = size * np.random.default_rng(seed).normal(size=(count, 3))
    square = (e**2).sum(axis=1)
    return np.stack([np.arange(count), square, np.full(count, 3.0 * stated**2), square, -square], axis=1)


def test_an_answer_is_scored_in_its_own_axes():
    """The frame's x axis along the first principal direction, z inward: K is diagonal there."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0.6, 0.8, 0.0], [0.8, -0.6, 0.0], [0.0, 0.0, -1.0]]).T
    C = np.diag([1.0, 4.0, 4.0])
    estimate = SimpleNamespace(T_frame_contact=T, K=np.diag([31.0, -12.0]), covariance=C)
    density = multivariate_normal(np.zeros(3), C).logpdf([1.0, 0.0, -2.0])
    record = SimpleNamespace(t_s=1.0, estimate=estimate)
    assert scored(record, TRUTH, ROW) == pytest.approx([1.0, 5, 13, 2, density])


def test_only_the_way_behind_a_jump_is_scored_apart():
    """A plane, an arc of 25 mm from 10 mm to 20 mm of way, a plane; and a curvature that grows as fast as on a wave."""
    way = np.arange(0.0, 30e-3, 0.05e-3)
    points = np.column_stack([way, 0 * way, 0 * way])
    arc = np.column_stack([np.where((way >= 10e-3) & (way < 20e-3), 40.0, 0.0), 0 * way])
    behind = behind_jump({"contact_point_m": points, "kappa_per_m": arc})
    expected = ((way >= 10e-3) & (way < 11.5e-3)) | ((way >= 20e-3) & (way < 21.5e-3))
    assert np.sum(behind != expected) <= 4  # places are sampled
    slow = np.column_stack([2000.0 * way, -2000.0 * way])
    assert not behind_jump({"contact_point_m": points, "kappa_per_m": slow}).any()


def test_a_row_tells_overconfidence_and_its_interval_is_over_scenes():
    # within a scene all answers are held alike: so many answers are no more than so many scenes
    scans = [scan(answers(0.5, seed=i), number=i) for i in range(9)] + [scan(answers(20.0), number=9)]
    row = row_of("kind", "sphere", [*scans, scan([], number=10, late=0, ended="refused: too far")])
    assert row["observed"] == 0.8
    assert (row["scenes"], row["refused"], row["stopped"], row["answers"]) == (11, 1, 0, 1000)
    assert row["below_40"] == pytest.approx(0.1)
    assert row["coverage"] == pytest.approx(0.9, abs=0.01)
    assert row["coverage_low"] < 0.75
    assert row["coverage_high"] > 0.99
    # a geometric mean over scenes: nine state twice, one a twentieth of their error
    assert row["stated_over_error"] == pytest.approx((2.0**9 / 20.0) ** 0.1, rel=0.05)
    assert row["stated_low"] < row["stated_over_error"] < row["stated_high"]
    assert row["seeds"] == "201000–201010"
    assert row["worst"].startswith("201009: ")


def test_findings_name_the_goals_that_are_missed_and_repeat_the_worst_scene():
    sound = [scan(answers(0.8, seed=i), "plane", number=i) for i in range(20)]
    scans = [*sound, *(scan(answers(9.0), "torus", number=i, behind=answers(30.0)) for i in range(4))]
    rows = rows_of(scans)
    said = findings(rows, scans)
    assert [row["of"] for row in rows if row["group"] == "kind"] == ["plane", "torus", "all but foreign"]
    goals = [line for line in said if line.startswith("Goal: ")]
    assert len(goals) == 4 and all("missed by" in line and "torus" in line for line in goals)
    assert any(line.startswith("Scored apart") for line in said)
    assert said[-1].endswith("canprobe study regions --seed 206003")
    assert all("met" in line for line in findings(rows_of(sound), sound)[3:])


def test_a_scene_without_answers_is_counted_and_another_one_is_drawn():
    class Answers:
        """Every third scene of a plane is refused, and every bowl."""

        def map(self, measure, todo, model):
            seeds = [SceneSeed.of(seed) for seed in todo]
            refused = [s.kind == "bowl" or s.number % 3 == 0 for s in seeds]
            return [
                [*scan([] if no else answers(1.0), s.kind, late=9 * (not no), number=s.number, ended="refused: x" * no)]
                for s, no in zip(seeds, refused, strict=True)
            ]

        def say(self, text):
            pass

    scans = scan_all(Answers(), 2, ("plane", "bowl"), 10)
    planes = [one for one in scans if one.kind == "plane"]
    assert sum(len(one.scores) > 0 for one in planes) == 10
    assert [one.seed for one in planes] == [200_000 + i for i in range(len(planes))]
    assert sum(one.kind == "bowl" for one in scans) == DRAWS_PER_SCENE * 10


def test_an_earlier_run_is_compared_by_kind(tmp_path):
    scans = [scan(answers(1.0, seed=i), "plane", number=i) for i in range(3)]
    file = tmp_path / "regions.json"
    file.write_text(json.dumps({"rows": rows_of(scans)}))
    now = rows_of([one._replace(late=200) for one in scans])
    said = compared(now, earlier_rows(file))
    assert "plane: refused 0 / 0, stopped 0 / 0, observed 0.5 / 0.8" in said[1]
    file.write_text('{"rows": 3}')
    with pytest.raises(UsageError, match=r"--against .*regions.json: expected the regions.json of an earlier run"):
        earlier_rows(file)


@pytest.mark.slow(reason="whole scenes of a study")
def test_random_scenes_follow_from_their_seeds(tmp_path):
    """They differ, cells and arrays of all groups occur, nearly all can be planned."""
    seeds = [SceneSeed(2, kind, number).value() for kind in KINDS for number in (0, 3)]
    drawn = [random_scene(seed, tmp_path) for seed in seeds]
    assert random_scene(seeds[3], tmp_path).scene == drawn[3].scene
    assert len({one.scene.task for one in drawn}) == len(seeds)
    assert {one.scene.cell.name for one in drawn} <= CELLS.keys()
    assert {one.group for one in drawn} == {"shipped", "foreign"}  # number 0 and 3; all others are calibrated
    refused = 0
    for one in drawn:
        try:
            make_plan(resolve(one.scene))
        except PlanError:
            refused += 1
    assert refused <= len(seeds) // 3
    with pytest.raises(UsageError, match="kind 99"):
        SceneSeed.of(299_000)


@pytest.mark.parametrize(
    "words, expected",
    [
        (["estimators", "--draw", "2"], "only calibration, faults, realtime --link, regions, surfaces has it"),
        (["regions", "--draw", "2", "--seed", "200000"], "--draw: study regions: a seed names its draw"),
        (["regions", "--against", str(Path("no") / "where.json")], "expected the regions.json of an earlier run"),
    ],
)
def test_wrong_options_are_refused(words, expected, tmp_path, capsys):
    try:
        assert main(["study", *words, "--out", str(tmp_path)]) == 2
    except SystemExit as end:
        assert end.code == 2
    assert expected in capsys.readouterr().err


@pytest.mark.slow(reason="a whole study in its quick form")
@pytest.mark.timeout(600)  # a second of a whole cell takes long where many share a processor
def test_a_small_draw_with_the_whole_sensor(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("canprobe.lab.studies.regions.QUICK_SCENES", 1)
    monkeypatch.setattr("canprobe.lab.studies.regions.KINDS", ("plane", "fillet"))
    assert main(["study", "regions", "--quick", "--draw", "2", "--out", str(tmp_path), "--json"]) == 0
    rows = {row["of"]: row for row in json.loads(capsys.readouterr().out)["rows"]}
    assert rows["plane"]["answers"] >= 20
    assert rows["plane"]["coverage"] > 0.5  # answers of 25 mm share one draw of the error
    assert (tmp_path / "regions.png").stat().st_size > 10_000
    lines = (tmp_path / "regions_scenes.csv").read_text().splitlines()
    assert lines[1].startswith("200000,plane,plane,")


@pytest.mark.slow(reason="a whole scene of a study")
def test_a_model_that_turned_over_on_a_straight_path_begins_again():
    """Contacts of a straight path do not tell how the gradient grows along it: here it passed zero, by 2.1 s."""
    scan = measure(106001)
    assert scan.share > 0.6  # 0.01 where the normal of the answers points the other way
    assert math.sqrt(float(np.mean(scan.scores[:, 1]))) < 5.0  # 50 1/m then
