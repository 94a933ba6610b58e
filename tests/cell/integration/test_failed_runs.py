"""What a run leaves behind that did not get far: every file, and a summary that is JSON."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest

import canprobe
from canprobe.api import OpenCell
from canprobe.cli import main
from canprobe.errors import NodeError, SafetyStop
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.tools.faults import BUS_FAULTS, Fault

FILES = {"bus.log", "log.npz", "scene.toml", "summary.json", "truth.npz"}


def read_json(path: Path) -> Any:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    return json.loads(path.read_text(), parse_constant=refuse)


def test_a_failed_bring_up_leaves_every_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Faulty(OpenCell):
        def __init__(self, *words: Any, **options: Any) -> None:
            super().__init__(*words, **options)
            self.session.buses.world.make_faulty([Fault(BUS_FAULTS["drop"], 3, 0, 60_000_000_000)])

    monkeypatch.setattr("canprobe.api.OpenCell", Faulty)
    (tmp_path / "report.png").write_text("of an earlier run")
    with pytest.raises(NodeError, match=r"node 3: \(joint 3\) sent no boot-up") as failed:
        canprobe.run("press", out=tmp_path, force=True)
    summary = read_json(tmp_path / "summary.json")
    assert summary == failed.value.summary
    assert (summary["completed"], summary["stop_reason"]) == (False, str(failed.value))
    assert summary["cycle"]["cycles"] == 0
    assert summary["sim_time_s"] == 0.0
    names = {path.name for path in tmp_path.iterdir()}
    assert names >= FILES and "report.png" not in names
    with np.load(tmp_path / "log.npz") as log:
        assert log["t_s"].shape == (0,)
    resets = [data for _, _, can_id, data in read_candump(tmp_path / "bus.log") if can_id == 0]
    assert resets.count(b"\x81\x03") == 3, "two retries"
    canprobe.load_scene(tmp_path / "scene.toml")


def test_a_file_that_does_not_fit_is_not_there_in_part_and_the_user_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "log.npz").write_text("of an earlier run")

    def full(file: IO[bytes], *_: Any, **__: Any) -> None:
        file.write(b"no more than this")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np.lib.format, "write_array", full)
    monkeypatch.setattr("canprobe.cell.master.cell.Cell.run", lambda *_: (_ for _ in ()).throw(SafetyStop("stopped")))
    assert main(["run", "free", "--out", str(tmp_path), "--force"]) == 1
    told = capsys.readouterr().err.splitlines()
    assert told == [
        "canprobe: stopped",
        f"canprobe: {tmp_path}/truth.npz: cannot be written: No space left on device",
        f"canprobe: {tmp_path}/log.npz: cannot be written: No space left on device",
    ]
    assert read_json(tmp_path / "summary.json")["stop_reason"] == "stopped"
    kept = {"bus.log", "scene.toml", "summary.json", "rows"}  # the rows of the run, which found no other place
    assert {path.name for path in tmp_path.iterdir()} <= kept
    assert (tmp_path / "rows" / "truth.npy.gz").exists()
