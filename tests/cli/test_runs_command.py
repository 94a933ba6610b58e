"""`canprobe runs`: what it lists and compares, and that it deletes runs that were asked for and nothing else."""

import io
import json
import os
import shutil
import time

import pytest
from undrawn import undrawn

import canprobe
from canprobe.cli import main


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    """Folder of a short run with all its files, of which the cell's EDS files are some."""
    out = tmp_path_factory.mktemp("runs") / "one"
    canprobe.run(undrawn(canprobe.load_scene("free", {"task.duration_s": 0.1})), out=out)
    return out


@pytest.fixture
def runs(one, tmp_path):
    """A folder with two whole runs, one that was killed long ago, one that may go on, and things that are no runs."""
    folder = tmp_path / "runs"
    for age_s, name in ((4000, "killed"), (3000, "first"), (2000, "second"), (1000, "noted"), (0, "going-on")):
        shutil.copytree(one, folder / name)
        if name in ("killed", "going-on"):
            (folder / name / "summary.json").unlink()
        for path in (folder / name).iterdir():
            os.utime(path, (time.time() - age_s,) * 2)
    (folder / "noted" / "notes.md").write_text("of mine")
    scene = folder / "second" / "scene.toml"
    scene.write_text(scene.read_text().replace("seed = 0", "seed = 7"))
    os.utime(scene, (time.time() - 2000,) * 2)
    (folder / "project").mkdir()
    shutil.copy(one / "scene.toml", folder / "project")
    (folder / "link").symlink_to(folder / "first")
    (folder / "README").write_text("of mine")
    return folder


def answer(capsys, *words):
    assert main(["runs", *map(str, words), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_runs_are_listed_by_age_with_size_and_verdict(runs, capsys):
    entries = answer(capsys, runs)
    assert [os.path.basename(entry["folder"]) for entry in entries] == [
        "killed",
        "first",
        "second",
        "noted",
        "going-on",
    ]
    assert {entry["scene"] for entry in entries} == {"free"}
    assert [entry["verdict"].partition(":")[0] for entry in entries] == ["no summary", *["done"] * 3, "no summary"]
    assert entries[1]["size_bytes"] == sum(path.stat().st_size for path in (runs / "first").iterdir())
    assert main(["runs", str(runs)]) == 0
    table = capsys.readouterr().out
    assert f"{runs}/second" in table and table.splitlines()[-1].startswith("5 runs, ")


def test_two_runs_are_compared_by_settings_and_figures(runs, capsys):
    summary = json.loads((runs / "second" / "summary.json").read_text())
    summary["cycle"]["overruns"] = 3
    (runs / "second" / "summary.json").write_text(json.dumps(summary))
    expected = {"settings": {"scene.seed": [0, 7]}, "figures": {"cycle.overruns": [0, 3]}}
    assert answer(capsys, runs / "first", runs / "second") == expected


def left_in(runs):
    return {path.name for path in runs.iterdir()} - {"project", "link", "README"}


def test_only_runs_are_deleted_and_only_after_a_yes(runs, capsys, monkeypatch):
    everything = left_in(runs)
    monkeypatch.setattr("sys.stdin", io.StringIO("no\n"))
    assert main(["runs", str(runs), "--prune"]) == 2
    assert (
        capsys.readouterr().err.splitlines()[-1].endswith("needs a yes at the terminal, or --yes; nothing was deleted")
    )
    assert left_in(runs) == everything
    assert main(["runs", str(runs), "--prune", "--keep", "3", "--yes"]) == 0
    assert left_in(runs) == {"second", "noted", "going-on"}
    capsys.readouterr()
    assert main(["runs", str(runs), "--prune", "--yes"]) == 0
    told = capsys.readouterr().err
    assert f"{runs}/noted: stays: holds notes.md, which no run wrote" in told
    assert f"{runs}/going-on: stays: changed less than 600 s ago" in told
    assert left_in(runs) == {"noted", "going-on"}
    assert {path.name for path in runs.iterdir()} > {"project", "README"} and (runs / "link").is_symlink()


@pytest.mark.parametrize(
    ("name", "why"), [("project", "got a scene without files of its run"), ("nowhere", "no such folder")]
)
def test_what_is_no_run_is_refused(name, why, runs, capsys):
    assert main(["runs", str(runs / name), "--prune", "--yes"]) == 2
    assert why in capsys.readouterr().err
    assert (runs / "project" / "scene.toml").is_file()
