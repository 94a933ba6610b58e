"""`canprobe export --lerobot`: a dataset that other readers take, whose rows are those of the log."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas
import pytest
from pyarrow import parquet

import canprobe
from canprobe.cli import main

SHORT = {"task.duration_s": 0.4, "outputs.figures": False}
ROW = "data/chunk-000/file-000.parquet"


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    for seed in (0, 1):
        scene = canprobe.load_scene("cylinder", {**SHORT, "bus.interface": "lockstep", "shape.also": []})
        canprobe.run(scene, seed=seed, out=folder / f"scan{seed}")
    canprobe.run(canprobe.load_scene("free", SHORT), out=folder / "free", bus="direct")
    return folder


@pytest.fixture(scope="module")
def dataset(folders, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets") / "dataset"
    assert main(["export", str(folders / "scan0"), str(folders / "scan1"), "--lerobot", str(folder)]) == 0
    return folder


def test_rows_are_the_cycles_of_the_log(dataset, folders):
    info = json.loads((dataset / "meta" / "info.json").read_text("utf-8"))
    log = np.load(folders / "scan0" / "log.npz")
    tactile = np.load(folders / "scan0" / "tactile.npz")
    rows = parquet.read_table(dataset / ROW).to_pandas()
    rows = rows[rows.episode_index == 0]
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["total_episodes"], len(rows)) == (400, 2, len(log["t_s"]))
    assert set(info["features"]) == set(rows.columns)
    np.testing.assert_allclose(rows.timestamp, np.arange(len(rows)) / 400, atol=1e-6)
    np.testing.assert_array_equal(rows.t_cell_s, log["t_s"])
    np.testing.assert_allclose(np.stack(rows["observation.state"]), log["q_rad"], atol=1e-6)
    driven = ~np.isnan(log["q_target_rad"]).any(axis=1)
    np.testing.assert_allclose(np.stack(rows["action"])[driven], log["q_target_rad"][driven], atol=1e-6)
    assert (rows["observation.phase"][np.isnan(log["phase"])] == -1).all()
    # a row with an image of its own, and the next one, which holds it
    k = int(np.searchsorted(log["t_s"], tactile["t_s"][-20]))
    image = tactile["taxels"][-20].reshape(-1) * (100.0 / 255.0)
    for row in (k, k + 1):
        np.testing.assert_allclose(rows["observation.tactile"][row], image, atol=1e-3)
        age = log["t_s"][row] - tactile["t_sample_s"][-20]
        assert rows["observation.tactile_age_s"][row] == pytest.approx(age, abs=1e-6)
    assert rows["observation.tactile_age_s"][0] == -1.0
    assert not any(np.isnan(np.stack(rows[name])).any() for name in rows.columns)


def test_another_reader_finds_no_fault(dataset):
    """lerobot-doctor reads the layout, features, statistics and times, and says FAIL for each that is wrong."""
    doctor = shutil.which("lerobot-doctor", path=str(Path(sys.executable).parent)) or shutil.which("lerobot-doctor")
    assert doctor is not None, "type: pip install -e '.[test]'"
    said = subprocess.run([doctor, "check", str(dataset)], capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stdout[-3000:]
    assert "8 PASS" in said.stdout
    assert "FAIL" not in said.stdout


def test_statistics_and_episodes(dataset):
    episodes = pandas.read_parquet(dataset / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    rows = parquet.read_table(dataset / ROW).to_pandas()
    assert list(episodes["canprobe/seed"]) == [0, 1]
    assert list(episodes["dataset_to_index"]) == [episodes["length"][0], len(rows)]
    stats = json.loads((dataset / "meta" / "stats.json").read_text("utf-8"))["observation.state"]
    values = np.stack(rows["observation.state"]).astype(np.float64)
    np.testing.assert_allclose(stats["mean"], values.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(stats["std"], values.std(axis=0), rtol=1e-4)
    tasks = pandas.read_parquet(dataset / "meta" / "tasks.parquet")
    assert tasks.index.name == "task"
    assert list(tasks.task_index) == [0]


def test_the_raw_folder_replays_to_the_same_estimates(dataset, folders, capsys):
    raw = dataset / "raw" / "episode-000001"
    answers = []
    for folder in (raw, folders / "scan1"):
        assert main(["replay", str(folder), "--json"]) == 0
        answers.append(json.loads(capsys.readouterr().out.replace(str(folder), "FOLDER")))
    assert answers[0] == answers[1]
    assert answers[0]
    assert not list(raw.glob("*.png"))
    assert (raw / "bus.log").exists()


def test_one_result_at_a_divisor_of_the_rate(tmp_path):
    result = canprobe.run(canprobe.load_scene("free", SHORT), bus="direct", files=False)
    result.to_lerobot(tmp_path / "free", fps=50)
    rows = parquet.read_table(tmp_path / "free" / ROW).to_pandas()
    np.testing.assert_allclose(np.stack(rows["observation.state"]), result.log["q_rad"][::8], atol=1e-6)
    assert "observation.tactile" not in rows.columns


@pytest.mark.parametrize(
    "case",
    [
        (["scan0", "free"], [], "expected the arm and the array of"),
        (["scan0"], ["--fps", "300"], "expected a whole divisor of the 400 cycles a second (400, 200, 100, 80, 50"),
        (["nothing"], [], "no such folder; expected one that `canprobe run --out DIR` wrote"),
        ([""], [], "no scene.toml in this folder; expected one that `canprobe run --out DIR` wrote"),
    ],
)
def test_what_is_no_dataset_is_refused_and_leaves_nothing(folders, tmp_path, capsys, case):
    runs, options, words = case
    target = tmp_path / "set"
    assert main(["export", *(str(folders / run) for run in runs), "--lerobot", str(target), *options]) == 2
    assert words in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_log_with_a_gap_is_refused(folders, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(folders / "free", run)
    columns = dict(np.load(run / "log.npz"))
    columns["t_s"][100:] += 0.004
    np.savez(run / "log.npz", **columns)
    assert main(["export", str(run), "--lerobot", str(tmp_path / "set")]) == 2
    assert "1 gaps between cycles, the first of 6.5 ms" in capsys.readouterr().err
