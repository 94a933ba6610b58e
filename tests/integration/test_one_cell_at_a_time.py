"""What must not meet: two runs in one folder, two controllers of one cell, a session that is over and a new start."""

from __future__ import annotations

import shutil
import signal

import numpy as np
import pytest
from undrawn import undrawn_run

import canprobe
from canprobe import results
from canprobe.api import Command, results_folder
from canprobe.bus.candump import CandumpWriter, read_candump
from canprobe.errors import UsageError


@pytest.fixture
def free():
    return canprobe.load_scene("free")


def test_a_folder_that_is_written_to_is_refused_and_keeps_its_log(free, tmp_path):
    with CandumpWriter(tmp_path / "bus.log", "can0") as writer:
        writer.write(0x080, b"", 0)
        writer.flush()
        with pytest.raises(UsageError, match="another run writes this file; choose another folder"):
            undrawn_run(free, out=tmp_path, duration_s=0.1)
        assert len(list(read_candump(tmp_path / "bus.log"))) == 1
        assert {path.name for path in tmp_path.iterdir()} == {"bus.log"}
    undrawn_run(free, out=tmp_path, duration_s=0.1)
    assert len(list(read_candump(tmp_path / "bus.log"))) > 100


def test_runs_of_one_second_have_folders_of_their_own(free):
    assert len({results_folder(free) for _ in range(3) if not signal.sigtimedwait([], 0.002)}) == 3


def test_a_controller_does_not_run_another_one_in_its_step(free):
    inner = []
    with canprobe.open_cell(free) as cell:

        def step(_):
            cell.run(lambda m: inner.append(m) or Command(done=True))

        with pytest.raises(UsageError, match="runs a controller already"):
            cell.run(step)
        cell.run(lambda _: Command(done=True))  # one after the other they may
    assert inner == []


@pytest.mark.parametrize("done", [np.array([True, False]), "no", None])
def test_done_is_true_or_false(free, done):
    with canprobe.open_cell(free) as cell, pytest.raises(UsageError, match="expected done to be True or False"):
        cell.run(lambda _: Command(done=done))


@pytest.mark.parametrize("ended", [True, False])
def test_a_session_is_opened_once(free, tmp_path, ended):
    with canprobe.open_cell(free, out=tmp_path) as cell:
        if not ended:
            with pytest.raises(UsageError, match="a session is opened once"):
                cell.__enter__()
    if ended:
        with pytest.raises(UsageError, match="a session is opened once"):
            cell.__enter__()
    assert len(list(read_candump(tmp_path / "bus.log"))) > 100


def test_the_scene_is_there_as_soon_as_the_log(free, tmp_path):
    with canprobe.open_cell(free, out=tmp_path):
        assert canprobe.load_scene(tmp_path / "scene.toml").name == "free"


def test_one_bridge_may_be_named_as_it_is(free, tmp_path):
    undrawn_run(free, out=tmp_path, duration_s=0.1, bridge="mcap")
    assert (tmp_path / "run.mcap").stat().st_size > 0


@pytest.mark.parametrize("name", ["log.npz", "summary.json", "scene.toml"])
def test_an_interrupt_waits_until_the_results_are_written(free, tmp_path, monkeypatch, name):
    for write in (results.write_text, results.write_npz):

        def interrupted(path, content, write=write):
            if path.name == name:
                signal.raise_signal(signal.SIGINT)
            write(path, content)

        monkeypatch.setattr(results, write.__name__, interrupted)
    with pytest.raises(KeyboardInterrupt):
        undrawn_run(free, out=tmp_path, duration_s=0.1)
    assert {path.name for path in tmp_path.iterdir()} >= {"summary.json", "log.npz", "scene.toml", "bus.log"}
    assert len(canprobe.load_table(tmp_path / "log.npz")) > 10


def test_the_truth_of_a_shorter_run_is_told(tmp_path):
    scene = canprobe.load_scene("cylinder")
    long = undrawn_run(scene, out=tmp_path / "long", duration_s=1.4)
    undrawn_run(canprobe.load_scene("free"), out=tmp_path / "short", duration_s=0.1)
    shutil.copy(tmp_path / "short" / "truth.npz", long.out / "truth.npz")
    with pytest.raises(UsageError, match="truth"):
        canprobe.replay(long.out)
