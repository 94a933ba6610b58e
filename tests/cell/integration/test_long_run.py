"""Long runs: what ends them leaves what was recorded until then. tests/bench measures their memory."""

import json
import subprocess
import sys
import time

import numpy as np
from full_disk import room_for

import canprobe
from canprobe.cell.master.options import RunOptions
from canprobe.cell.rows import BLOCK_ROWS, ROWS_FOLDER, read_left_rows
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cli import main

COMMAND = [sys.executable, "-m", "canprobe", "run", "press", "--bus", "direct", "--duration", "3000", "--out"]


def test_a_run_that_is_killed_leaves_its_rows(tmp_path):
    process = subprocess.Popen([*COMMAND, str(tmp_path)], stderr=subprocess.PIPE)
    rows = tmp_path / ROWS_FOLDER
    while not rows.is_dir() or len(read_left_rows(tmp_path, "log").get("t_s", ())) < 2 * BLOCK_ROWS:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    process.kill()
    process.communicate()
    assert {path.name for path in tmp_path.iterdir()} == {"scene.toml", ROWS_FOLDER}
    table = canprobe.load_table(tmp_path / "log.npz")
    assert len(table) >= 2 * BLOCK_ROWS
    np.testing.assert_allclose(np.diff(table.index), 0.0025, atol=1e-9)
    truth = canprobe.load_table(tmp_path / "truth.npz")
    assert abs(len(truth) - len(table)) <= BLOCK_ROWS
    both = min(len(truth), len(table))
    np.testing.assert_allclose(truth["q_rad_1"][:both], table["q_rad_1"][:both], atol=1e-3)
    images = canprobe.load_table(tmp_path / "tactile.npz")
    assert abs(2 * len(images) - len(table)) <= 2 * BLOCK_ROWS
    whole = canprobe.run("free", bus="direct", duration_s=0.1, out=tmp_path, force=True)
    assert not (tmp_path / ROWS_FOLDER).exists()
    assert len(canprobe.load_table(tmp_path / "log.npz")) == len(whole.log["t_s"])


def test_rows_that_no_longer_fit_on_the_disk_stop_the_run_and_stay(tmp_path, capsys):
    with room_for(200_000):
        status = main(["run", "free", "--bus", "direct", "--duration", "60", "--out", str(tmp_path), "--json"])
    assert status == 3
    assert f"{tmp_path}/{ROWS_FOLDER}/log-" in capsys.readouterr().err.splitlines()[0]
    assert not json.loads((tmp_path / "summary.json").read_text())["completed"]
    assert len(canprobe.load_table(tmp_path / "log.npz")) > 2 * BLOCK_ROWS


def test_a_session_alone_leaves_no_rows(tmp_path):
    """`calibrate array` and the studies read its log from memory and write no file of it."""
    scene = canprobe.load_scene("free", {"task.duration_s": 1.0, "bus.interface": "direct"})
    with Session(scene, RunOptions(tmp_path)) as session:
        session.run(make_task(session.plan))
    assert len(session.cell.log.arrays()["t_s"]) > 400
    assert {path.name for path in tmp_path.iterdir()} == {"scene.toml", "truth.npz"}
