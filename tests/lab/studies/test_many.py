"""`run_many`: every combination and seed once, the results of single runs, failures as rows, resumed, in any script."""

import json
import subprocess
import sys

import numpy as np
import pytest
from patience import patience_s

import canprobe
from canprobe.errors import SceneError, UsageError
from canprobe.fieldbus.eds.packaged import eds_path
from canprobe.lab.studies import many
from canprobe.lab.studies.many import run_many
from canprobe.lab.studies.sweep import Sweep

QUICK = {"task.clearance_mm": 0.2, "task.duration_s": 0.2, "cycle.rate_hz": 200.0}
VARY = {"limits.force_max_n": [5.0, np.float64(2.1)], "bus.bit_error_rate": [0.0, 1e-5]}
SERIES = ("force_n", "contact_mm", "truth.force_n")


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("many")


@pytest.fixture(scope="module")
def runs(out):
    scene = canprobe.load_scene("press", QUICK)
    return run_many(scene, VARY, seeds=2, bus="direct", workers=1, out=out, series=SERIES, every_ms=10)


def test_a_row_for_every_combination_and_seed_failures_too(runs):
    table = runs.table()
    assert len(table) == len(runs) == 8
    assert table["limits.force_max_n"].tolist() == [5.0] * 4 + [2.1] * 4
    assert table["seed"].tolist() == [0, 1] * 4
    words = ["done", "done", "refused", "refused", "stopped", "stopped", "refused", "refused"]
    assert table["status"].tolist() == words
    assert "bus.bit_error_rate needs a bus" in table["reason"][2] and "force" in table["reason"][4]
    assert table["version"].str.startswith(f"{canprobe.__version__}+").all()
    assert "8 runs, 2 done, 4 refused, 2 stopped" in repr(runs) and "4 × bus.interface" in repr(runs)
    assert "<table" in runs._repr_html_()


def test_each_is_the_run_that_it_stands_for(runs):
    one = canprobe.run("press", QUICK, bus="direct", seed=1, files=False)
    row = runs.table().iloc[1]
    assert row["contact.force_max_n"] == one.summary["contact"]["force_max_n"]
    data = runs.to_xarray()
    assert data["force_n"].attrs == data["truth.force_n"].attrs == {"units": "N"}
    assert data["contact_mm"].dims == ("run", "time", "contact_mm_0") and data["contact_mm"].attrs == {"units": "mm"}
    assert data["time"].attrs == {"units": "s"}
    assert data["status"].values.tolist() == runs.table()["status"].tolist()
    of_one, rows = data["force_n"].sel(run=1), len(one.log["force_n"][::2])
    np.testing.assert_allclose(of_one["time"][:3], [0.0, 0.01, 0.02])
    np.testing.assert_array_equal(of_one[:rows], one.log["force_n"][::2])
    assert np.isnan(data["truth.force_n"][4]).all()


def test_what_is_finished_is_found_again_and_the_rest_is_computed(runs, out, monkeypatch):
    kept = (out / "cells.jsonl").read_text()
    said = []
    scene = canprobe.load_scene("press", QUICK)
    again = run_many(scene, VARY, seeds=2, bus="direct", out=out, series=SERIES, every_ms=10, say=said.append)
    assert again.outcomes == runs.outcomes and (out / "cells.jsonl").read_text() == kept
    assert said == [f"8 of 8 cells are kept in {out}/cells.jsonl"]
    monkeypatch.setattr(many.importlib.util, "find_spec", lambda _: None)
    assert again.table()[0]["contact.force_target_n"] == 2.0


def test_a_fault_of_one_run_costs_that_run(monkeypatch, out):
    case = many.RunCase(many.dump_scene(canprobe.load_scene("press")), "", 0, (), 50.0)
    monkeypatch.setattr(many, "run_plan", lambda *_, **__: {}["nothing"])
    outcome = many.measure(case)
    assert outcome["status"] == "failed" and outcome["reason"].startswith("KeyError: 'nothing' (test_many.py:")


def test_all_runs_use_the_files_as_they_were_and_changed_files_are_other_runs(tmp_path, monkeypatch):
    """The file is removed once the first run is done; what ran is found again by its content, and by nothing else."""
    mine, out, done = tmp_path / "mine.eds", tmp_path / "out", []
    text = eds_path("tactile_array").read_bytes()
    mine.write_bytes(text)
    scene = canprobe.load_scene("listen", {"sensor.eds": mine, "task.duration_s": 0.05})

    def in_this_process(sweep, measure, cells):
        for case in cells:
            done.append((case.files, measure(case)["status"]))
            mine.unlink(missing_ok=True)
        return [{"status": status} for _, status in done]

    monkeypatch.setattr(Sweep, "map", in_this_process)
    run_many(scene, seeds=2, bus="direct", out=out)
    assert [status for _, status in done] == ["done", "done"]
    (copy,) = out.glob("files-*/mine.eds")
    assert copy.read_bytes() == text
    for content in (text, text + b"\n; a comment\n"):
        mine.write_bytes(content)
        run_many(scene, seeds=1, bus="direct", out=out)
    first, second, same, other = (digest for digest, _ in done)
    assert first == second == same != other


def test_other_estimators_compute_where_they_are_asked_for(tmp_path, monkeypatch):
    asked = []

    def note(_, __, cases):
        asked.extend(many.parse_scene(case.scene).shape.also for case in cases)
        return [{"status": "done"}] * len(cases)

    monkeypatch.setattr(Sweep, "map", note)
    scene = canprobe.load_scene("cylinder")
    assert scene.shape.also
    run_many(scene, bus="direct", out=tmp_path)
    run_many(scene, {"shape.also": [["ml"], []]}, bus="direct", out=tmp_path)
    assert asked == [(), ("ml",), ()]


def test_numbers_of_numpy_are_integers_as_others(tmp_path, monkeypatch):
    monkeypatch.setattr(Sweep, "map", lambda *_: [])
    seeds = [np.int64(3), np.uint8(4), 5]
    runs = run_many("free", seeds=seeds, bus="direct", out=tmp_path)
    assert [row["seed"] for row in runs.rows] == [3, 4, 5]
    assert [row["seed"] for row in run_many("free", seeds=np.int32(2), bus="direct", out=tmp_path).rows] == [0, 1]
    assert [row["seed"] for row in run_many("free", seeds=np.arange(2), bus="direct", out=tmp_path).rows] == [0, 1]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"vary": {"task.force_n": 3}}, "vary: task.force_n: expected a list of values, got 3"),
        ({"vary": {"task.force": [3]}}, r"task\.force: unknown key; did you mean force_n\?"),
        ({"vary": {"task.force_n": []}}, r"vary: task\.force_n: expected at least one value, got an empty list"),
        ({"vary": {"task.force_n": np.array(3.0)}}, r"vary: task\.force_n: expected a list of values, got array\(3"),
        ({"seeds": [-1]}, r"scene\.seed: expected an integer from 0"),
        ({"seeds": 0}, "seeds: expected at least one, got 0"),
        ({"seeds": []}, r"seeds: expected at least one, got \[\]"),
        ({"seeds": [1.5]}, r"seeds: expected a number, or a list of integers, got \[1\.5\]"),
        ({"bus": "socketcan"}, 'runs share no bus: expected bus="direct" or "lockstep"'),
    ],
)
def test_mistakes_are_told_before_anything_is_started(given, told, tmp_path):
    with pytest.raises((UsageError, SceneError), match=told):
        run_many("press", out=tmp_path / "none", **given)
    assert not (tmp_path / "none").exists()


def test_a_series_that_no_run_has(runs, out):
    with pytest.raises(UsageError, match=r"series: no run has a column forcen; they have .*force_n"):
        many.Runs(runs.scene, runs.keys, runs.rows, runs.outcomes, ("forcen",), 0.01).to_xarray()


@pytest.mark.slow(reason="a script with its processes; the default has many runs without one")
def test_a_script_needs_no_guard(tmp_path):
    """Workers do not import the script that starts them."""
    (tmp_path / "script.py").write_text(
        "import canprobe, json\n"
        "scene = canprobe.load_scene('listen', {'task.duration_s': 0.1})\n"
        "runs = canprobe.run_many(scene, seeds=2, bus='direct', workers=2)\n"
        "print(json.dumps([outcome['status'] for outcome in runs.outcomes]))\n"
    )
    command = [sys.executable, "script.py"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=patience_s(120))
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout) == ["done", "done"] and ended.stderr == ""
    assert (tmp_path / "runs/many-listen/cells.jsonl").is_file()
