"""A study's result as text, CSV, JSON and picture, and the facts that go with every measurement."""

from __future__ import annotations

import csv
import importlib.util
import json
import math
import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import canprobe
from canprobe.studies.study import Column, StudyResult
from canprobe.studies.sweep_store import model_digest
from canprobe.whole_file import whole_file, write_text

SIGMA_COLUMNS = (
    Column("sigma_point_um", "σp µm", ".0f"),
    Column("sigma_normal_mrad", "σn mrad", ".1f"),
)
"""Noise of a row, filled by `sigma_values`."""


def measuring_facts(quick: bool, seeds: int, model: Sequence[str] = ()) -> dict[str, Any]:
    """Machine, versions and settings of a study; `model` as for `Sweep.map`."""
    return {
        "canprobe": canprobe.__version__,
        "commit": _commit(),
        "model": model_digest(tuple(model)),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "machine": _processor(),
        "quick": quick,
        "seeds": seeds,
    }


def sigma_values(sigma_point: float, sigma_normal: float) -> dict[str, float]:
    """The values of `SIGMA_COLUMNS`, from m and rad."""
    return {"sigma_point_um": sigma_point * 1e6, "sigma_normal_mrad": sigma_normal * 1e3}


def table_lines(result: StudyResult) -> list[str]:
    """The table, one line a row, numbers flush right."""
    cells = [[c.heading for c in result.columns]]
    cells += [[_shown(row.get(c.key), c.form) for c in result.columns] for row in result.rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    words = [bool(result.rows) and isinstance(result.rows[0].get(c.key), str) for c in result.columns]
    return [
        "  ".join(
            t.ljust(w) if is_word else t.rjust(w) for t, w, is_word in zip(line, widths, words, strict=True)
        ).rstrip()
        for line in cells
    ]


def text_of(result: StudyResult) -> str:
    """Facts, table and findings, of all its tables."""
    facts = ", ".join(f"{name} {value}" for name, value in result.facts.items() if value is not None)
    own = [f"study {result.name}: {facts}", "", *table_lines(result), "", *result.findings, ""]
    return "\n".join([*own, *(f"\n{text_of(more)}" for more in result.more)])


def as_document(result: StudyResult) -> dict[str, Any]:
    """For `--json`: no NaN, what does not apply is null."""
    more = {"more": [as_document(part) for part in result.more]} if result.more else {}
    return {
        "study": result.name,
        "facts": dict(result.facts),
        "findings": list(result.findings),
        "rows": [{key: _plain(value) for key, value in row.items()} for row in result.rows],
        **more,
    }


def write_study(result: StudyResult, out: Path) -> list[Path]:
    """Write `<name>.csv`, `.txt`, `.json` and, where matplotlib is installed, `.png`.

    Returns:
        The files of each table, its picture last where there is one.

    Raises:
        ResultsError: one cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / f"{result.name}.{end}" for end in ("csv", "txt", "json")]
    with whole_file(paths[0]) as part, part.open("w", newline="", encoding="utf-8") as file:
        _write_csv(csv.writer(file), result)
    write_text(paths[1], text_of(result))
    document = json.dumps(as_document(result), indent=1, allow_nan=False, ensure_ascii=False)
    write_text(paths[2], document + "\n")
    if importlib.util.find_spec("matplotlib") is not None:
        paths.append(out / f"{result.name}.png")
        with whole_file(paths[-1]) as part:
            result.draw(part)
    return [*paths, *(path for more in result.more for path in write_study(more, out))]


def _write_csv(writer: Any, result: StudyResult) -> None:
    keys: Sequence[str] = list(dict.fromkeys(key for row in result.rows for key in row))
    writer.writerow(keys)
    for row in result.rows:
        writer.writerow(["" if (v := _plain(row.get(key))) is None else v for key in keys])


def _shown(value: Any, form: str) -> str:
    value = _plain(value)
    if value is None:
        return "–"
    return "yes" if value is True else "no" if value is False else format(value, form)


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _commit() -> str | None:
    where = Path(canprobe.__file__).parent
    try:
        done = subprocess.run(
            ["git", "-C", str(where), "describe", "--always", "--dirty"],
            capture_output=True, text=True, check=False, timeout=5.0,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
