"""`canprobe run`: what it prints, in which order, and what it draws."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from canprobe.cli import main


def run(out: Path, *words: str) -> list[str]:
    """The lines of stdout and stderr, in the order in which they appeared."""
    command = [sys.executable, "-m", "canprobe", "run", "cylinder", "--bus", "direct", "--duration", "1.2", "-v"]
    command += ["--set", "cycle.rate_hz=200"]
    done = subprocess.run(
        [*command, "--out", str(out), *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=True
    )
    return done.stdout.splitlines()


@pytest.mark.slow(reason="a whole run with other estimators and pictures")
def test_the_summary_comes_before_other_estimators_and_pictures(tmp_path: Path) -> None:
    lines = run(tmp_path, "--full", "--set", 'shape.also=["chen1996"]')
    words = [line.split()[0] for line in lines]
    again, drawn = lines.index("estimate again with chen1996"), lines.index("draw report.png")
    assert words.index("recursive") < words.index("map") < again < drawn < words.index("files")
    assert drawn < words.index("chen1996")  # its errors are below what was printed early
    assert (tmp_path / "report.png").stat().st_mtime_ns >= (tmp_path / "summary.json").stat().st_mtime_ns


def test_the_verdict_is_the_beginning_and_the_headline_of_each_figure(tmp_path: Path) -> None:
    """Five lines below the first one; what the others say is in summary.json."""
    lines = run(tmp_path, "--no-figures")
    head = lines.index("cylinder on direct, seed 0: done")
    assert [line.split()[0] for line in lines[head + 1 : head + 6]] == [
        "time",
        "cycle",
        "force",
        "contact",
        "curvature",
    ]
    summary = json.loads((tmp_path / "summary.json").read_text())
    shape, force = summary["shape"], summary["contact"]
    assert (
        f"RMS error {shape['kappa_rms_error_per_m']:.2f} 1/m ({shape['kappa_rms_error_percent']:.1f} %)"
        in lines[head + 5]
    )
    assert f"off it by {force['force_rms_error_n']:.3f} N RMS" in lines[head + 3]
    assert len(shape["methods"]) > 1 and not [line for line in lines if "chen1996  " in line or "measured less" in line]
    assert not [line for line in lines if line.startswith("draw ")]
    assert not list(tmp_path.glob("*.png")) + list(tmp_path.glob("*.html"))


def test_listening_says_how_many_images_came_and_their_force(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["run", "listen", "--duration", "1", "--no-figures", "--out", str(tmp_path / "run")]
    assert main(words) == 0
    said = re.search(
        r"images     (\d+) \(([\d.]+) a second\), force ([\d.]+) N mean, ([\d.]+) N highest", capsys.readouterr().out
    )
    assert said is not None
    images, rate, mean, highest = map(float, said.groups())
    with np.load(tmp_path / "run" / "tactile.npz") as tactile, np.load(tmp_path / "run" / "log.npz") as log:
        force = log["force_n"]
        assert images == len(tactile["taxels"]) and rate == pytest.approx(200.0, rel=0.02)
    assert (mean, highest) == pytest.approx((np.nanmean(force), np.nanmax(force)), abs=0.006)
    assert 0.0 < mean < highest


SHORT = ["run", "cylinder", "--duration", "0.3", "--set", "cycle.rate_hz=200", "--set", "bus.timed=false"]
SHORT += ["--set", "task.clearance_mm=0.3", "--set", "shape.also=[]", "--no-figures", "--out"]
FILES = {"truth": "truth.npz", "surface_map": "surface.npz", "bus_log": "bus.log", "figures": "report.png"}
"""File of each output."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run with all outputs."""
    out = tmp_path_factory.mktemp("whole") / "run"
    assert main([*SHORT, str(out)]) == 0
    return out


@pytest.mark.parametrize("off", [("truth",), ("surface_map",), ("bus_log",), tuple(FILES)], ids="+".join)
def test_outputs_that_are_off_are_not_written_and_said(
    off: tuple[str, ...], whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The frames of the bus are the same, and whatever reads the folder does with what is there."""
    out = str(tmp_path / "run")
    assert main([*SHORT, out, *(word for name in off for word in ("--set", f"outputs.{name}=false"))]) == 0
    written = {path.name for path in Path(out).iterdir()}
    assert {name for name, file in FILES.items() if file not in written} == {*off, "figures"}
    summary = json.loads((Path(out) / "summary.json").read_text())
    for name in off:
        assert any(f"outputs.{name} = false" in line for line in summary["left_out"])
    assert (summary["contact"]["force_true_rms_error_n"] is None) == ("truth" in off)
    assert ("map" in summary["shape"]) == ("surface_map" not in off)
    assert summary["traffic"]["can0"]["as_planned"]
    if "bus_log" not in off:
        assert (Path(out) / "bus.log").read_bytes() == (whole / "bus.log").read_bytes()
    capsys.readouterr()
    assert main(["replay", out, "--json"]) == 0
    replayed = json.loads(capsys.readouterr().out)
    assert replayed["shape"]["map"] is not None
    assert main(["runs", str(tmp_path)]) == 0
    assert main(["plan", f"{out}/scene.toml", "--measured", out]) == (2 if "bus_log" in off else 0)
    assert ("outputs.bus_log = true" in capsys.readouterr().err) == ("bus_log" in off)


def test_only_some_outputs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "free", "--duration", "0.1", "--out", str(tmp_path / "run"), "--only"]
    assert main([*words, "log,bus-log"]) == 2
    assert "--only: expected some of log,truth,surface_map,bus_log,figures, got bus-log; did you mean bus_log?" in (
        capsys.readouterr().err
    )
    assert main([*words, "log,bus_log"]) == 0
    assert {path.name for path in (tmp_path / "run").iterdir()} >= {"bus.log", "log.npz", "summary.json"}
    assert not (tmp_path / "run" / "truth.npz").exists() and not (tmp_path / "run" / "report.png").exists()


def test_the_old_key_of_figures_names_the_new_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "free", "--set", "scene.figures=false"]) == 2
    assert "scene.figures: unknown key; did you mean outputs.figures?" in capsys.readouterr().err
