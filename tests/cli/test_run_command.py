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
