"""A disk without room: one status and one line with the file's name from every command, and no part of a file."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from dataclasses import replace

import pytest
from full_disk import room_for
from undrawn import undrawn_run

import canprobe
from canprobe.cli import main
from canprobe.errors import ResultsError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.lab.studies.cell_store import CellStore

ROOM = 2000


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """Folder of half a second over the cylinder."""
    scene = canprobe.load_scene("cylinder")
    scene = replace(scene, shape=replace(scene.shape, also=()), task=replace(scene.task, clearance_mm=0.8))
    return undrawn_run(scene, out=tmp_path_factory.mktemp("full") / "scan", duration_s=0.5).out


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["plan", "cylinder", "--export", "dcf", "--out", "."], "node001.dcf"),
        (["plan", "cylinder", "--export", "dbc", "--out", "."], "cylinder.dbc"),
        (["plan", "cylinder", "--export", "kcd", "--out", "."], "cylinder.kcd"),
        (["plan", "cylinder", "--export", "bus.yml", "--out", "."], "puma260_joint.eds"),
        (["plan", "cylinder", "--figure", "plan.png"], "plan.png"),
        (["replay", "SCAN", "--out", "estimates.npz"], "estimates.npz"),
        (["view", "SCAN", "--html", "page.html"], "page.html"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_a_command_leaves_no_part_of_a_file(words, name, scan, tmp_path, capsys):
    with contextlib.chdir(tmp_path), room_for(ROOM):
        status = main([str(scan) if word == "SCAN" else word for word in words])
    assert (status, capsys.readouterr().err) == (3, f"canprobe: {name}: cannot be written: File too large\n")
    assert list(tmp_path.iterdir()) == []


def test_a_run_whose_frames_cannot_be_written_lets_go_and_ends_with_the_same_status(tmp_path, capsys):
    out = tmp_path / "run"
    with room_for(150_000):
        status = main(["run", "free", "--duration", "5", "--out", str(out), "--json"])
    told = capsys.readouterr().err.splitlines()
    assert (status, told[0]) == (3, f"canprobe: {out}/bus.log: cannot be written: File too large")
    assert (out / "bus.log").read_text().endswith("\n")
    *_, (_, _, last, data) = read_candump(out / "bus.log")
    assert last < 0x800 and len(data) <= 8
    whole = {"bus.log", "scene.toml", "summary.json", "log.npz", "truth.npz", "report.png"}
    left = {path.name for path in out.iterdir()}
    assert left <= whole and {"scene.toml", "summary.json"} <= left
    for line in told[1:]:  # whatever else did not fit
        name = line.removeprefix(f"canprobe: {out}/").partition(":")[0]
        assert "cannot be written" in line and name in whole - left


def test_a_study_s_cells_that_were_kept_before_are_whole(tmp_path):
    store = CellStore(tmp_path)
    store.put("a", "cell", "1")
    with room_for(ROOM), pytest.raises(ResultsError, match=r"cells\.jsonl: cannot be written"):
        try:
            store.put("b", "x" * ROOM, "2")
        finally:
            store.close()
    again = CellStore(tmp_path)
    assert again.answers == {"a": "1"}
    again.close()


def test_a_full_standard_output_has_the_same_status():
    with open("/dev/full", "wb") as full:
        command = [sys.executable, "-m", "canprobe", "scenes"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, check=False)
    told = b"canprobe: standard output: cannot be written: No space left on device\n"
    assert (done.returncode, done.stderr) == (3, told)
