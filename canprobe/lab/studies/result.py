"""The result of a study: a table with its facts and findings, and a picture; as text, CSV, JSON and PNG."""

from __future__ import annotations

import contextlib
import csv
import json
import math
import platform
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import canprobe
from canprobe.cell.scene.units import unit_of
from canprobe.fieldbus.bus.files import make_folder, whole_file, write_text
from canprobe.lab.studies.cell_store import PACKAGE, model_digest
from canprobe.mechanics.types import Floats

Say = Callable[[str], None]
Row = dict[str, Any]
"""A row of a table, by the keys of its columns."""
CHI2_95_OF_3 = 7.815
FROBENIUS = np.array([1.0, 2.0, 1.0])
"""Weights of (K11², K12², K22²) in ‖K‖²."""
UNITS = {
    **{end: unit_of(end).text for end in ("n_m3", "n_m", "n", "us", "um", "hz", "kpa", "percent")},
    "per_m": "1/m",
    "mib": "MiB",
}
"""Units at the end of a key that a table spells otherwise."""


@dataclass(frozen=True, slots=True, eq=False)
class StudyResult:
    """The result of a study.

    Attributes:
        name: name of the study.
        rows: one row for each case, by keys with their unit at the end; None where a value does not apply.
        findings: sentences with figures.
        facts: machine, versions and settings of the measurement.
        draw: function that writes the picture to a path; it needs matplotlib.
        columns: keys of the rows that the printed table has, by default all; the CSV has all.
        more: further tables of the study, each with its findings, files and picture.
    """

    name: str
    rows: Sequence[Row]
    findings: Sequence[str]
    facts: Mapping[str, Any]
    draw: Callable[[Path], None]
    columns: Sequence[str] = ()
    more: Sequence[StudyResult] = ()


BOOTSTRAPS = 2000


def drawn_anew(count: int) -> NDArray[np.int64]:
    """Indices (`BOOTSTRAPS`, count) of repeats that are drawn anew, with replacement.

    Source: Efron and Tibshirani, "An introduction to the bootstrap", 1993.
    """
    return np.random.default_rng(0).integers(count, size=(BOOTSTRAPS, count))


def interval_of(values: Floats) -> tuple[float, float]:
    """Lowest and highest of the middle 95 % of values."""
    low, high = np.quantile(values, [0.025, 0.975]).tolist()
    return low, high


def mean_and_interval(key: str, values: Floats) -> Row:
    """Mean of some repeats, with the interval of 95 % of the repeats drawn anew, NaN where a repeat is."""
    known = bool(len(values)) and bool(np.isfinite(values).all())
    low, high = interval_of(values[drawn_anew(len(values))].mean(axis=1)) if known else (math.nan, math.nan)
    return {key: float(values.mean()) if known else math.nan, f"{key}_low": low, f"{key}_high": high}


def measuring_facts(quick: bool, seeds: int, model: Sequence[str] = ()) -> dict[str, Any]:
    """Machine, versions and settings of a study; `model` as for `Sweep.map`."""
    commit = ""
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        command = ["git", "-C", str(PACKAGE), "describe", "--always", "--dirty"]
        commit = subprocess.run(command, capture_output=True, text=True, check=False, timeout=5.0).stdout.strip()
    return {
        "canprobe": canprobe.__version__,
        "commit": commit or None,
        "model": model_digest(tuple(model)),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "machine": processor(),
        "quick": quick,
        "seeds": seeds,
    }


def processor() -> str:
    """The name of this machine's processor, or else its architecture."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.machine()


def sigma_values(sigma_point: float, sigma_normal: float) -> dict[str, float]:
    """Noise of a row, from m and rad."""
    return {"sigma_point_um": sigma_point * 1e6, "sigma_normal_mrad": sigma_normal * 1e3}


def table_lines(result: StudyResult) -> list[str]:
    """The table, a line for each row, numbers flush right."""
    columns = result.columns or list(dict.fromkeys(key for row in result.rows for key in row))
    cells = [[heading(key) for key in columns]]
    cells += [[shown(row.get(key)) for key in columns] for row in result.rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    words = [bool(result.rows) and isinstance(result.rows[0].get(key), str) for key in columns]
    return [
        "  ".join(
            t.ljust(w) if is_word else t.rjust(w) for t, w, is_word in zip(line, widths, words, strict=True)
        ).rstrip()
        for line in cells
    ]


def heading(key: str) -> str:
    """Heading of a column: the words of its key, such as `force max N` of `force_max_n`."""
    unit = next((unit for unit in UNITS if key.endswith(f"_{unit}")), "")
    words = key.removesuffix(unit).replace("_", " ")
    return f"{words}{UNITS[unit]}" if unit else words


def text_of(result: StudyResult) -> str:
    """Facts, table and findings of all its tables."""
    facts = ", ".join(f"{name} {value}" for name, value in result.facts.items() if value is not None)
    own = [f"study {result.name}: {facts}", "", *table_lines(result), "", *result.findings, ""]
    return "\n".join([*own, *(f"\n{text_of(more)}" for more in result.more)])


def as_document(result: StudyResult) -> dict[str, Any]:
    """The document of `--json`; what does not apply is null, never NaN."""
    more = {"more": [as_document(part) for part in result.more]} if result.more else {}
    return {
        "study": result.name,
        "facts": dict(result.facts),
        "findings": list(result.findings),
        "rows": [{key: _plain(value) for key, value in row.items()} for row in result.rows],
        **more,
    }


def write_study(result: StudyResult, out: Path) -> list[Path]:
    """Write `<name>.csv`, `.txt`, `.json` and `.png`.

    Returns:
        The files of each table, its picture last.

    Raises:
        ResultsError: one cannot be written.
    """
    make_folder(out)
    paths = [out / f"{result.name}.{end}" for end in ("csv", "txt", "json", "png")]
    write_csv(paths[0], result.rows)
    write_text(paths[1], text_of(result))
    document = json.dumps(as_document(result), indent=1, allow_nan=False, ensure_ascii=False)
    write_text(paths[2], document + "\n")
    result.draw(paths[3])
    return [*paths, *(path for more in result.more for path in write_study(more, out))]


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows with a column for each of their keys; what does not apply is empty."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        lines = [["" if (v := _plain(row.get(key))) is None else v for key in keys] for row in rows]
        csv.writer(file).writerows([keys, *lines])


def shown(value: Any) -> str:
    """A value as a table shows it: four digits, all of those before the point; a dash for what does not apply."""
    value = _plain(value)
    if value is None:
        return "–"
    if isinstance(value, float):
        return f"{value:.0f}" if 1e4 <= abs(value) < 1e6 else f"{value:.4g}"
    return {True: "yes", False: "no"}[value] if isinstance(value, bool) else str(value)


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
