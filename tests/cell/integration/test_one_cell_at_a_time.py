"""What must not meet: two runs in one folder, two controllers of one cell, a session that is over and a new start."""

from __future__ import annotations

import json
import signal

import numpy as np
import pytest
from undrawn import undrawn, undrawn_run

import canprobe
from canprobe.api import results_folder
from canprobe.cell.master.controller import Command
from canprobe.cell.npz import read_npz
from canprobe.cell.session import folder as recording
from canprobe.cell.session.session import with_bridges
from canprobe.cli import main
from canprobe.errors import InterfaceError, SafetyStop, UsageError
from canprobe.fieldbus.bus.candump import CandumpWriter, read_candump


@pytest.fixture
def free():
    return canprobe.load_scene("free")


def test_a_folder_that_is_written_to_is_refused_and_keeps_its_log(free, tmp_path):
    with CandumpWriter(tmp_path / "bus.log", "can0") as writer:
        writer.write(0x080, b"", 0)
        writer.flush()
        with pytest.raises(UsageError, match="another run writes this file; choose another folder"):
            undrawn_run(free, out=tmp_path, duration_s=0.1, force=True)
        assert len(list(read_candump(tmp_path / "bus.log"))) == 1
        assert {path.name for path in tmp_path.iterdir()} == {"bus.log"}
    undrawn_run(free, out=tmp_path, duration_s=0.1, force=True)
    assert len(list(read_candump(tmp_path / "bus.log"))) > 100


FILES = {"bus.log", "log.npz", "scene.toml", "summary.json", "truth.npz"}


def nod(measurement):
    return Command(done=measurement.cycle > 100, columns={"own_m": 0.5})


def test_a_controller_of_ones_own_leaves_what_a_run_leaves(free, tmp_path):
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "surface.npz").write_text("of an earlier run")
    with canprobe.open_cell(undrawn(free), out=tmp_path / "own", force=True) as cell:
        result = cell.run(nod)
        with pytest.raises(UsageError, match=r"result\.summary: complete when the block of open_cell is left"):
            _ = result.summary["completed"]
    task = undrawn_run(free, out=tmp_path / "task", duration_s=0.1)
    names = {path.name for path in task.out.iterdir()}
    assert names >= FILES and {path.name for path in result.out.iterdir()} == names
    assert result.summary["completed"] and result.summary.keys() == task.summary.keys()
    assert result.summary["bus_load"]["can0"]["measured"] > 0.01
    assert result.summary["traffic"]["can0"]["as_planned"] == task.summary["traffic"]["can0"]["as_planned"]
    assert json.loads((result.out / "summary.json").read_text()) == result.summary
    assert np.nanmax(np.load(result.out / "log.npz")["own_m"]) == 0.5
    assert result.truth["t_s"].shape[0] >= len(result.log["t_s"]) > 100 and "done" in result.text()
    assert main(["view", str(result.out), "--html", str(tmp_path / "own.html")]) == 0


def test_several_controllers_in_one_block_are_one_run(free, tmp_path):
    with canprobe.open_cell(undrawn(free), out=tmp_path) as cell:
        first = cell.run(lambda m: Command(done=m.cycle > 100))
        second = cell.run(lambda m: Command(done=m.cycle > 300, columns={"second": 1.0}))
    assert first is second and second.summary["cycle"]["cycles"] > 300
    assert len(second.log["t_s"]) == len(read_npz(tmp_path / "log.npz")["t_s"]) > 300
    with pytest.raises(UsageError, match="the cell is closed: open another one"):
        cell.run(nod)


@pytest.mark.parametrize(("error", "reason"), [(ValueError("oh"), "ValueError: oh"), (None, "oh")])
def test_a_block_that_is_left_by_an_error_leaves_its_files_too(free, tmp_path, error, reason):
    def fail(measurement):
        if measurement.cycle > 100 and error is not None:
            raise error
        return Command(stop_reason="oh" if measurement.cycle > 100 else None)

    with pytest.raises((ValueError, SafetyStop)) as raised, canprobe.open_cell(undrawn(free), out=tmp_path) as cell:
        cell.run(fail)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["completed"], summary["stop_reason"]) == (False, reason)
    assert getattr(raised.value, "summary", summary) == summary
    assert {path.name for path in tmp_path.iterdir()} >= FILES


def test_a_cell_is_opened_once_and_used_while_it_is_open(free):
    cell = canprobe.open_cell(free)
    for use in (lambda: cell.run(nod), lambda: cell.cell):
        with pytest.raises(UsageError, match=r"use `with canprobe\.open_cell\(scene\) as cell:`"):
            use()
    with cell:
        with pytest.raises(UsageError, match="a session is opened once"):
            cell.__enter__()
        result = cell.run(nod)
    assert len(result.log["t_s"]) > 100


def test_results_replace_others_only_where_that_is_wanted(free, tmp_path, capsys):
    run = ["run", "free", "--no-figures", "--duration", "0.1", "--out", str(tmp_path)]
    undrawn_run(free, out=tmp_path, duration_s=0.1)
    (tmp_path / "surface.npz").write_text("of an earlier run")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(UsageError, match="not empty: name another folder for the results"):
        canprobe.open_cell(free, out=tmp_path)
    for words in (run, ["view", "free", *run[3:], "--html", "x.html"]):
        assert main(words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"canprobe: {tmp_path}: not empty") and "--force" in line
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    assert main([*run, "--force", "--seed", "1"]) == 0
    assert not (tmp_path / "surface.npz").exists()
    assert json.loads((tmp_path / "summary.json").read_text())["seed"] == 1


def test_a_run_that_does_not_begin_replaces_nothing(free, tmp_path):
    (tmp_path / "summary.json").write_text("of an earlier run")
    with pytest.raises(InterfaceError):
        canprobe.run(free, bus="socketcan", channel="nobus0", out=tmp_path, force=True)
    assert [path.read_text() for path in tmp_path.iterdir()] == ["of an earlier run"]


def test_a_cell_that_is_left_open_keeps_its_last_cycles(free, tmp_path):
    with canprobe.open_cell(undrawn(free), out=tmp_path, rows_kept=20) as cell:
        result = cell.run(nod)
    assert len(result.log["t_s"]) == 20 and result.truth == {} and not (tmp_path / "truth.npz").exists()
    assert result.summary["cycle"]["cycles"] > 100


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


def test_a_controller_advances_in_pieces_as_in_one_run(free):
    seen = {"whole": [], "pieces": []}

    def swing(measurement, into):
        into.append((measurement.cycle, measurement.t_ns, measurement.enabled, *measurement.q))
        return Command(q_target=measurement.q + 1e-3 * np.sin(measurement.cycle / 10), done=len(into) == 40)

    with canprobe.open_cell(free) as cell:
        cell.run(lambda measurement: swing(measurement, seen["whole"]))
    with canprobe.open_cell(free) as cell:
        cell.cell.start(lambda measurement: swing(measurement, seen["pieces"]))
        assert [cell.cell.advance(16) for _ in range(3)] == [False, False, True]
    assert seen["pieces"] == seen["whole"] and len(seen["whole"]) == 40


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("done", np.array([True, False]), "expected done to be True or False"),
        ("done", None, "expected done to be True or False"),
        ("stop_reason", 3, "expected stop_reason to be a text or None, got 3"),
        ("stop_reason", " ", "expected stop_reason to be a text or None, got ' '"),
        ("columns", None, "expected columns to be a dict of numbers by name, got None"),
        ("columns", {3: 1.0}, r"expected the names of columns to be printable texts, got \[3\]"),
        ("columns", {"a\0b": 1.0}, "expected the names of columns to be printable texts"),
        ("estimate", "flat", "expected estimate to be a SurfaceEstimate, got 'flat'"),
    ],
)
def test_a_field_of_a_command_that_is_something_else_is_named(free, field, value, says):
    with canprobe.open_cell(free) as cell, pytest.raises(UsageError, match=f"^controller: {says}"):
        cell.run(lambda _: Command(**{field: value}))


def test_a_joint_target_needs_an_arm():
    with canprobe.open_cell("listen") as cell, pytest.raises(UsageError, match="no q_target in a scene without an arm"):
        cell.run(lambda _: Command(q_target=np.zeros(6)))


@pytest.mark.filterwarnings("ignore:log. 3 values of column 'odd'")
@pytest.mark.parametrize("odd", [[1.0, [2.0, 3.0]], "text"])
def test_a_column_that_is_no_number_costs_only_itself(free, tmp_path, odd):
    commands = iter([Command(columns={"odd": odd})] * 3 + [Command(columns={"even": 7.0}, done=True)])
    with canprobe.open_cell(undrawn(free), out=tmp_path) as cell:
        cell.run(lambda _: next(commands))
    log = read_npz(tmp_path / "log.npz")
    assert np.isnan(log["odd"]).all() and np.nanmax(log["even"]) == 7.0


def test_one_bridge_may_be_named_as_it_is(free):
    assert with_bridges(free, "mcap").bridge.use == with_bridges(free, ["mcap"]).bridge.use == ("mcap",)
    assert canprobe.open_cell(free, bridge="mcap").plan.scene.bridge.use == ("mcap",)


def test_an_interrupt_waits_until_the_results_are_written(free, tmp_path, monkeypatch):
    def interrupted(path, content, write=recording.write_npz):
        if path.name == "log.npz":
            signal.raise_signal(signal.SIGINT)
        write(path, content)

    monkeypatch.setattr(recording, "write_npz", interrupted)
    with pytest.raises(KeyboardInterrupt):
        undrawn_run(free, out=tmp_path, duration_s=0.1)
    assert {path.name for path in tmp_path.iterdir()} >= {"summary.json", "log.npz", "scene.toml", "bus.log"}
    assert len(canprobe.load_table(tmp_path / "log.npz")) > 10
