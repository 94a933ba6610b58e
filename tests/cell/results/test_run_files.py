"""The files of a run's folder that are cut off, edited, or of another version: one clear line each."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from undrawn import undrawn_run

import canprobe
from canprobe.cell.emulated.world import with_units
from canprobe.cell.npz import read_npz
from canprobe.cli import main
from canprobe.errors import UsageError


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a short scan without a bus."""
    short = {"task.duration_s": 0.3, "task.clearance_mm": 0.5, "shape.also": []}
    out = tmp_path_factory.mktemp("run") / "scan"
    undrawn_run(canprobe.load_scene("cylinder", short), bus="direct", out=out)
    return out


@pytest.fixture
def folder(scan: Path, tmp_path: Path) -> Path:
    return shutil.copytree(scan, tmp_path / "run")


def with_columns(name: str, change: Callable[[dict[str, np.ndarray]], object]) -> Callable[[Path], None]:
    def rewrite(folder: Path) -> None:
        columns = dict(read_npz(folder / name))
        change(columns)
        np.savez(folder / name, **columns)

    return rewrite


def with_bytes(name: str, content: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(content((folder / name).read_bytes())) and None


def make_pipe_of_log(folder: Path) -> None:
    (folder / "log.npz").unlink()
    os.mkfifo(folder / "log.npz")


BROKEN = {
    "cut off": (
        with_bytes("log.npz", lambda data: data[: len(data) // 2]),
        "log.npz: expected the log of a run; can",
    ),
    "a pipe": (make_pipe_of_log, "cannot be read: expected a regular file, got a device or a pipe"),
    "no times": (with_columns("log.npz", lambda c: c.pop("t_s")), "log.npz: expected the columns of a run, got none c"),
    "NaN time": (
        with_columns("log.npz", lambda c: np.put(c["t_s"], 3, np.nan)),
        "log.npz: t_s: expected a time in seconds in each row, got others",
    ),
    "times that go back": (
        with_columns("log.npz", lambda c: c.update(t_s=c["t_s"][::-1])),
        "log.npz: t_s: expected times that rise from cycle to cycle, got others",
    ),
    "0-d": (with_columns("log.npz", lambda c: c.update(force_n=np.array(1.0))), "log.npz: force_n: expected "),
    "text": (
        with_columns("log.npz", lambda c: c.update(force_n=np.full(len(c["t_s"]), "x"))),
        "log.npz: force_n: exp",
    ),
    "another length": (
        with_columns("log.npz", lambda c: c.update(phase=c["phase"][:-1])),
        "log.npz: phase: expected ",
    ),
}
SHAPED = {
    "other joints": (
        with_columns("log.npz", lambda c: c.update(q_rad=c["q_rad"][:, :5])),
        "log.npz: q_rad: expected floats of shape (",
    ),
    "no such phase": (
        with_columns("log.npz", lambda c: c.update(phase=c["phase"] + 99)),
        "log.npz: phase: expected numbers from 0 to ",
    ),
    "another array": (
        with_columns("tactile.npz", lambda c: c.update(taxels=c["taxels"][:, 1:])),
        "tactile.npz: taxels: expected counts (uint8) of shape (",
    ),
    "windows beside the array": (
        with_columns("tactile.npz", lambda c: c.update(window=c["window"] + 99)),
        "tactile.npz: window: expected windows within the array, got others",
    ),
    "no summary": (
        with_bytes("summary.json", lambda _: b"[]"),
        "summary.json: expected the summary of a run, got",
    ),
    "brackets": (
        with_bytes("summary.json", lambda _: b"[" * 100_000),
        "summary.json: expected the summary of a run: ",
    ),
}


def last_line(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == "" and "Traceback" not in err
    return err.splitlines()[-1]


@pytest.mark.parametrize("kind", [*BROKEN, *SHAPED])
def test_a_broken_file_is_named_with_its_column(kind: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change, told = (BROKEN | SHAPED)[kind]
    change(folder)
    line = last_line(capsys, "replay", str(folder), "--method", "chord")
    assert line.startswith(f"canprobe: {folder}/") and told in line
    if kind in ("cut off", "other joints"):
        assert last_line(capsys, "view", str(folder), "--html", str(folder / "page.html")) == line
    if kind in BROKEN:
        pytest.importorskip("pandas")
        with pytest.raises(UsageError) as refused:
            canprobe.load_table(folder / "log.npz")
        assert line == f"canprobe: {refused.value}" or kind in ("0-d", "text", "another length")


def test_a_truth_of_another_shape_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with_columns("truth.npz", lambda c: c.update(kappa_per_m=c["kappa_per_m"][:, :1]))(folder)
    assert "truth.npz: kappa_per_m: expected floats of shape (" in last_line(capsys, "replay", str(folder))
    with_columns("truth.npz", lambda c: c.pop("kappa_per_m"))(folder)
    assert "truth.npz: expected the columns of a run, got none called kappa_per_m" in last_line(
        capsys, "replay", str(folder)
    )


def test_joints_that_slide_have_their_own_column_of_the_truth() -> None:
    q = np.array([[1.0, 0.2], [1.1, 0.3]])
    truth = with_units({"t_s": np.arange(2.0), "q": q, "force": np.array([0.0, 2.0])}, (False, True))
    assert list(truth) == ["t_s", "q_rad", "q_m", "force_n"]
    assert np.isnan(truth["q_rad"][:, 1]).all() and np.isnan(truth["q_m"][:, 0]).all()


def test_a_column_of_an_own_controller_has_any_shape(folder: Path) -> None:
    pytest.importorskip("pandas")
    with_columns("log.npz", lambda c: c.update(force_n=np.zeros((len(c["t_s"]), 2)), phase=c["phase"] + 99))(folder)
    assert {"force_n_0", "force_n_1", "phase"} <= set(canprobe.load_table(folder / "log.npz"))


@pytest.mark.parametrize("name", ["bus.log", "scene.toml"])
def test_other_files_that_are_no_text(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "tactile.npz").unlink()
    (folder / "bus.log").write_bytes(b"")
    (folder / name).write_bytes(bytes(range(256)))
    assert f"{folder / name}:" in last_line(capsys, "replay", str(folder))


def test_a_folder_of_another_version_says_so(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    own = f"this is canprobe {canprobe.__version__}"
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["written_by"] == f"canprobe {canprobe.__version__}"
    scene = (folder / "scene.toml").read_text()
    assert scene.startswith(f'written_by = "canprobe {canprobe.__version__}"\n')
    newer = scene.replace(canprobe.__version__, "9.1.0", 1).replace("[task]\n", "[task]\nhaste = 3\n")
    (folder / "scene.toml").write_text(newer)
    line = last_line(capsys, "replay", str(folder))
    assert line == f"canprobe: {folder}/scene.toml: written by canprobe 9.1.0, {own}: task.haste: unknown key"
    (folder / "scene.toml").write_text(newer.partition("\n")[2])  # as before there was this line
    (folder / "summary.json").write_text(json.dumps({"schema": 1}))
    line = last_line(capsys, "view", str(folder), "--html", "page.html")
    assert line == f"canprobe: {folder}/scene.toml: written by an earlier canprobe, {own}: task.haste: unknown key"
    (folder / "scene.toml").write_text(scene.replace(canprobe.__version__, "9.1.0", 1))
    with_columns("log.npz", lambda c: c.pop("q_age"))(folder)
    (folder / "summary.json").write_text(json.dumps({"schema": 1, "written_by": "canprobe 9.1.0"}))
    line = last_line(capsys, "replay", str(folder))
    assert line.startswith(f"canprobe: {folder}/log.npz: written by canprobe 9.1.0, {own}: expected the columns")
    (folder / "summary.json").write_text(json.dumps({"schema": 3, "written_by": "canprobe 9.1.0"}))
    told = (
        f"summary.json: written by canprobe 9.1.0, {own}: the file is of a newer canprobe: this one reads up to schema"
    )
    assert told in last_line(capsys, "replay", str(folder))
