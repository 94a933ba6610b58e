"""`run_many`: every combination and seed once, the results of single runs, failures as rows, resumed, in any script."""

import json
import subprocess
import sys

import numpy as np
import pytest

import canprobe
from canprobe.eds.packaged import eds_path
from canprobe.errors import SceneError, UsageError
from canprobe.studies import many
from canprobe.studies.many import run_many

QUICK = {"task.clearance_mm": 0.5, "task.duration_s": 0.2}
VARY = {"limits.force_max_n": [5.0, np.float64(2.01)], "bus.bit_error_rate": [0.0, 1e-5]}
SERIES = ("force_n", "contact_mm", "truth.force")


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
    assert table["limits.force_max_n"].tolist() == [5.0] * 4 + [2.01] * 4
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
    assert data["force_n"].attrs == data["truth.force"].attrs == {"units": "N"}
    assert data["contact_mm"].dims == ("run", "time", "contact_mm_0") and data["contact_mm"].attrs == {"units": "mm"}
    assert data["time"].attrs == {"units": "s"}
    assert data["status"].values.tolist() == runs.table()["status"].tolist()
    of_one, rows = data["force_n"].sel(run=1), len(one.log["force_n"][::4])
    np.testing.assert_allclose(of_one["time"][:3], [0.0, 0.01, 0.02])
    np.testing.assert_array_equal(of_one[:rows], one.log["force_n"][::4])
    assert np.isnan(data["truth.force"][4]).all()


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
    case = many.Case(many.dump_scene(canprobe.load_scene("press")), "", 0, (), 50.0)
    monkeypatch.setattr(many, "run", lambda *_, **__: {}["nothing"])
    outcome = many.measure(case)
    assert outcome["status"] == "failed" and outcome["reason"].startswith("KeyError: 'nothing' (test_many.py:")


def test_a_run_is_another_once_a_file_that_its_scene_names_has_changed(tmp_path):
    copy = tmp_path / "a.eds"
    copy.write_bytes(eds_path("tactile_array").read_bytes())
    scene = canprobe.load_scene("press", {"sensor.eds": copy})
    before = many._digest(scene)
    assert (
        before
        == many._digest(canprobe.load_scene(scene, {"task.force_n": 1}))
        != many._digest(canprobe.load_scene("press"))
    )
    copy.write_bytes(copy.read_bytes() + b"\n; a comment\n")
    assert many._digest(scene) != before


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"vary": {"task.force_n": 3}}, "vary: task.force_n: expected a list of values, got 3"),
        ({"vary": {"task.force": [3]}}, r"task\.force: unknown key; did you mean force_n\?"),
        ({"seeds": [-1]}, r"scene\.seed: expected an integer from 0"),
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


def test_a_script_needs_no_guard(tmp_path):
    """Workers do not import the script that starts them."""
    (tmp_path / "script.py").write_text(
        "import canprobe, json\n"
        "scene = canprobe.load_scene('listen', {'task.duration_s': 0.1})\n"
        "runs = canprobe.run_many(scene, seeds=2, bus='direct', workers=2)\n"
        "print(json.dumps([outcome['status'] for outcome in runs.outcomes]))\n"
    )
    command = [sys.executable, "script.py"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout) == ["done", "done"] and ended.stderr == ""
    assert (tmp_path / "runs/many-listen/cells.jsonl").is_file()
