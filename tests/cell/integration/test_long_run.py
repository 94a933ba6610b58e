"""Long runs: memory does not grow with their rows, and what ends them leaves what was recorded until then."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from full_disk import room_for

import canprobe
from canprobe.cell.master.options import RunOptions
from canprobe.cell.rows import BLOCK_ROWS, ROWS_FOLDER, read_left_rows
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cli import main

COMMAND = [sys.executable, "-m", "canprobe", "run"]


def started(out, *words):
    """A run in a process, once some blocks of its rows are on disk."""
    process = subprocess.Popen([*COMMAND, *words, "--duration", "3000", "--out", str(out)], stderr=subprocess.PIPE)
    rows = out / ROWS_FOLDER
    while not rows.is_dir() or len(read_left_rows(out, "log").get("t_s", ())) < 2 * BLOCK_ROWS:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.05)
    return process


def test_a_run_that_is_killed_leaves_its_rows(tmp_path, capsys):
    process = started(tmp_path, "press", "--bus", "direct")
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


@pytest.mark.slow(reason="a long run in a process; tests/cli/test_bad_input.py interrupts a short one")
def test_an_interrupt_leaves_all_files(tmp_path):
    process = started(tmp_path, "cylinder", "--bus", "direct", "--no-figures")
    process.send_signal(signal.SIGTERM)
    process.communicate()
    assert process.returncode == 128 + signal.SIGTERM
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["completed"], summary["stop_reason"]) == (False, "interrupted")
    files = {"scene.toml", "summary.json", "log.npz", "tactile.npz", "truth.npz", "surface.npz"}
    assert {path.name for path in tmp_path.iterdir()} == files
    with np.load(tmp_path / "log.npz") as log:
        assert 0 <= summary["cycle"]["cycles"] - len(log["t_s"]) <= 1  # an interrupt comes between SYNC and row


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


MEMORY = """
import re, sys
import canprobe
scene, seconds, out = sys.argv[1], float(sys.argv[2]), sys.argv[3]
canprobe.run(scene, {"outputs.figures": False}, bus="direct", duration_s=seconds, out=out)
print(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1])  # ru_maxrss is of who started this, too
"""


def most_mib(scene, seconds, out):
    """Largest resident size of a run."""
    words = [sys.executable, "-c", MEMORY, scene, str(seconds), str(out)]
    env = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    return int(subprocess.run(words, env=env, stdout=subprocess.PIPE, check=True).stdout) / 1024


@pytest.mark.slow(reason="two minutes of a cell")
@pytest.mark.timeout(600)
def test_rows_of_two_minutes_take_no_memory(tmp_path):
    """44 000 cycles more: in memory they take 63 MiB (`files=False`); on disk 21, most of it while columns are made."""
    assert most_mib("free", 120, tmp_path / "long") < most_mib("free", 10, tmp_path / "short") + 40


@pytest.mark.slow(reason="two minutes of a cell")
@pytest.mark.timeout(600)
def test_a_scan_of_two_minutes_ends_with_all_its_files(tmp_path):
    """Contacts and answers are kept until 200 s and 400 s; an hour has no more of them."""
    out = tmp_path / "run"
    assert most_mib("cylinder", 120, out) < 700  # 510 were seen; an hour must stay below 1000
    summary = json.loads((out / "summary.json").read_text())
    assert summary["completed"] and summary["shape"]["map"]["contacts"] > 120 * 190
    files = {"scene.toml", "summary.json", "log.npz", "tactile.npz", "truth.npz", "surface.npz"}
    assert {path.name for path in out.iterdir()} == files
    with np.load(out / "log.npz") as log:
        assert len(log["t_s"]) == summary["cycle"]["cycles"] > 120 * 400
