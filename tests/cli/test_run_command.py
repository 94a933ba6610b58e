"""`canprobe run`: what it prints, in which order, and what it draws."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def run(out: Path, *words: str) -> list[str]:
    """The lines of stdout and stderr, in the order in which they appeared."""
    command = [sys.executable, "-m", "canprobe", "run", "cylinder", "--bus", "direct", "--duration", "1.2", "-v"]
    done = subprocess.run(
        [*command, "--out", str(out), *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=True
    )
    return done.stdout.splitlines()


def test_the_summary_comes_before_other_estimators_and_pictures(tmp_path: Path) -> None:
    lines = run(tmp_path, "--set", 'shape.also=["chen1996"]')
    words = [line.split()[0] for line in lines]
    again, drawn = lines.index("estimate again with chen1996"), lines.index("draw report.png")
    assert words.index("recursive") < words.index("map") < again < drawn < words.index("files")
    assert drawn < words.index("chen1996")  # its errors are below what was printed early
    assert (tmp_path / "report.png").stat().st_mtime_ns >= (tmp_path / "summary.json").stat().st_mtime_ns


def test_no_figures(tmp_path: Path) -> None:
    lines = run(tmp_path, "--no-figures", "--set", "shape.also=[]")
    assert not [line for line in lines if line.startswith(("draw ", "estimate again"))]
    assert (tmp_path / "summary.json").exists() and not list(tmp_path.glob("*.png")) + list(tmp_path.glob("*.html"))
