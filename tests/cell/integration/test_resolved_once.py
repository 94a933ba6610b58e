"""A run is resolved once: what ran is what is written and scored, whatever becomes of the scene's files."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from undrawn import undrawn, undrawn_run

import canprobe
from canprobe.cell.master.observers import Observation
from canprobe.cell.npz import read_npz
from canprobe.cell.scene.load import packaged_files
from canprobe.cell.scene.model import Scene
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cli import main
from canprobe.errors import ResultsError
from canprobe.fieldbus.eds.packaged import eds_path

SHORT = {
    "task.duration_s": 0.4,
    "cycle.rate_hz": 200.0,
    "task.clearance_mm": 0.2,
    "task.length_mm": 8.0,
    "task.width_mm": 2.0,
    "shape.memory_mm": 3,
    "shape.also": ["ml"],
}
COPIES = {"calibration.toml", "joint.eds", "taxels.eds", "relief.npz", "real.toml"}
"""Files that stand beside the scene of a run."""


def make_inputs(folder: Path) -> Scene:
    """A scene that names files of its own folder only: cell, array, calibration, EDS, heights, true cell."""
    folder.mkdir()
    scene = packaged_files("scenes")["relief"]
    shutil.copy(scene.with_suffix(".npz"), folder)
    shutil.copy(eds_path("puma260_joint"), folder / "joint.eds")
    shutil.copy(eds_path("tactile_array"), folder / "taxels.eds")
    shutil.copy(packaged_files("calibrations")["inch16"], folder / "calibration.toml")
    shutil.copy(packaged_files("arrays")["inch16"], folder / "array.toml")
    cell = packaged_files("cells")["puma260"].read_text()
    (folder / "real.toml").write_text(cell)
    (folder / "cell.toml").write_text(
        cell.replace("puma260_joint.eds", "joint.eds").replace('array = "inch16"', 'array = "array.toml"')
    )
    sensor = '[sensor]\neds = "taxels.eds"\ncalibration = "calibration.toml"\n[plant]\ntrue_cell = "real.toml"\n'
    (folder / "scene.toml").write_text('cell = "cell.toml"\n' + scene.read_text().replace("[sensor]\n", sensor))
    return undrawn(canprobe.load_scene(folder / "scene.toml", SHORT))


def recalibrate(folder: Path) -> None:
    """Another array: its layer is twice as stiff, and the drives and the surface are others too."""
    for name, old, new in (
        ("calibration.toml", "stiffness_n_m3 = ", "stiffness_n_m3 = 2"),
        ("joint.eds", "DefaultValue=0x00000260", "DefaultValue=0x00000261"),
        ("real.toml", "d_mm = 330.2", "d_mm = 331.2"),
    ):
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))
    with np.load(folder / "relief.npz") as saved:
        columns = dict(saved)
    np.savez(folder / "relief.npz", **{**columns, "heights": 2.0 * columns["heights"]})


def without_times(summary: dict[str, Any]) -> dict[str, Any]:
    cycle = {name: value for name, value in summary["cycle"].items() if not name.endswith("_us")}
    without_folder = [line.rpartition("/")[2] for line in summary["left_out"]]
    return summary | {
        "left_out": without_folder,
        "wall_time_s": None,
        "realtime_factor": None,
        "cycle": cycle,
        "bridges": None,
    }


def test_files_that_change_and_are_removed_meanwhile_change_nothing(tmp_path: Path) -> None:
    undisturbed = canprobe.run(make_inputs(tmp_path / "left"), bus="direct", out=tmp_path / "undisturbed")
    assert undisturbed.out is not None
    inputs, out = tmp_path / "inputs", tmp_path / "run"
    scene = make_inputs(inputs)

    def remove_amid(observation: Observation) -> None:
        if observation.measurement is not None and observation.measurement.cycle == 100:
            shutil.rmtree(inputs)

    cell = canprobe.open_cell(scene, bus="direct", out=out, observers=[remove_amid])
    recalibrate(inputs)
    with cell:
        result = cell.run(make_task(cell.plan))
    assert {path.name for path in out.iterdir()} >= COPIES
    for name in COPIES | {"scene.toml"}:
        assert (out / name).read_bytes() == (undisturbed.out / name).read_bytes(), name
    summary = json.loads((out / "summary.json").read_text())
    assert summary["shape"]["methods"].keys() == {"recursive", "ml"}
    assert without_times(summary) == without_times(undisturbed.summary)
    for name, columns in (("log.npz", undisturbed.log), ("tactile.npz", undisturbed.tactile)):
        for column, values in read_npz(out / name).items():
            if column != "sync_late_us":
                np.testing.assert_array_equal(values, columns[column], err_msg=f"{name}: {column}")
    scores = [[line.split()[:-1] for line in repr(one.score("ml")).splitlines()] for one in (result, undisturbed)]
    assert scores[0] == scores[1], "but for the time that they took"
    again = canprobe.replay(out)
    assert again.summary["online"]["K_max_difference_per_m"] == 0.0
    assert json.loads(json.dumps(again.summary["shape"])) == summary["shape"]


def test_scores_that_fail_do_not_cost_what_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr("canprobe.cell.results.open_cell.summarise", broken)
    with pytest.raises(np.linalg.LinAlgError):
        undrawn_run(canprobe.load_scene("listen"), bus="direct", duration_s=0.1, out=tmp_path)
    assert len(read_npz(tmp_path / "log.npz")["t_s"]) > 30
    assert len(read_npz(tmp_path / "tactile.npz")["t_s"]) > 10


def test_a_picture_that_fails_costs_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(*_: object) -> None:
        raise ValueError("'foo' is not a valid backend")

    monkeypatch.setattr("canprobe.cell.results.figures.draw_run", broken)
    told = "canprobe: report.png: cannot be drawn: ValueError: 'foo' is not a valid backend\n"
    assert main(["run", "listen", "--bus", "direct", "--duration", "0.1", "--out", str(tmp_path)]) == 3
    assert capsys.readouterr().err == told
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"summary.json", "log.npz", "tactile.npz", "truth.npz", "scene.toml"}


@pytest.mark.parametrize("name", ["summary.json", "log.npz"])
def test_one_file_that_cannot_be_written_does_not_cost_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    def in_the_way(observation: Observation) -> None:
        (tmp_path / name).mkdir(exist_ok=True)

    with pytest.raises(ResultsError, match=rf"{name}: cannot be written: Is a directory") as failed:
        undrawn_run(canprobe.load_scene("listen"), bus="direct", duration_s=0.1, out=tmp_path, observers=[in_the_way])
    assert failed.value.summary is not None and failed.value.summary["faults"] == [str(failed.value)]
    others = {"summary.json", "log.npz", "tactile.npz"} - {name}
    assert all((tmp_path / other).is_file() for other in others)
