"""What a study is: a table with its facts and findings, and a picture; its files; the store of its finished cells."""

from __future__ import annotations

import atexit
import contextlib
import csv
import dataclasses
import fcntl
import functools
import hashlib
import importlib.util
import json
import math
import platform
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

import canprobe
from canprobe.cell.scene.model import Scene
from canprobe.errors import ResultsError, StudyError
from canprobe.fieldbus.bus.files import make_folder, whole_file, write_text, writing
from canprobe.fieldbus.eds.packaged import eds_file

Say = Callable[[str], None]
Array = NDArray[np.float64]
Row = dict[str, Any]
"""A row of a table, by the keys of its columns."""
CHANNEL = "vcan0"
"""The interface of studies in real time."""
CHI2_95_OF_3 = 7.815
FROBENIUS = np.array([1.0, 2.0, 1.0])
"""Weights of (K11², K12², K22²) in ‖K‖²."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a study's table.

    Attributes:
        key: of the rows, and the heading in the CSV; ends in the unit.
        heading: in the printed table.
        form: how a value is printed, as for `format`.
    """

    key: str
    heading: str
    form: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class StudyResult:
    """What a study found.

    Attributes:
        name: of the study.
        columns: of the table.
        rows: one a case; None where a value does not apply.
        findings: sentences with figures.
        facts: what it was measured with.
        draw: writes the picture to a path; needs matplotlib.
        more: further tables of the study, each with its findings, files and picture.
    """

    name: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    findings: Sequence[str]
    facts: Mapping[str, Any]
    draw: Callable[[Path], None]
    more: Sequence[StudyResult] = ()


# Finished cells of a sweep on disk.
#
# A line of `cells.jsonl` is the SHA-256 of its document, a space, and the document: the cell's key, what it was
# measured by and at, and the answer. Lines are added whole and at once; one that was cut short or changed is left out
# and counted. The key is a digest of the measuring function, the cell and the model (`model_digest`): an answer of
# other code is not found.

PACKAGE = Path(canprobe.__file__).parent
_SOURCES = (".py", ".toml", ".eds")


def as_json(value: object) -> str:
    """Canonical JSON: dataclasses are objects, arrays and tuples lists, keys sorted; NaN and infinity are kept."""
    return json.dumps(value, sort_keys=True, default=_as_json_type, ensure_ascii=False)


def _as_json_type(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if hasattr(value, "tolist"):  # numpy's scalars and arrays
        return value.tolist()
    raise TypeError(f"expected numbers, text, lists, mappings, arrays or dataclasses of them, got {type(value)}")


@functools.cache
def model_digest(parts: tuple[str, ...] = ()) -> str:
    """Digest of the code that answers rest on, of Python and of numpy.

    Args:
        parts: files and folders of the package, such as "touch" or "studies/bound.py"; the whole package by default.

    Raises:
        StudyError: a part is not there.
    """
    found: set[Path] = set()
    for part in parts or (".",):
        where = PACKAGE / part
        inside = [where] if where.is_file() else [p for p in where.rglob("*") if p.suffix in _SOURCES]
        if not inside:
            raise StudyError(f"model: expected a file or folder of the package, got {part!r}")
        found.update(inside)
    digest = hashlib.sha256(f"{platform.python_version()} {version('numpy')}".encode())
    for path in sorted(found):
        digest.update(f"\n{path.relative_to(PACKAGE)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def cell_key(measure: str, cell: object, model: str) -> str:
    """The key of an answer."""
    return hashlib.sha256(as_json([measure, cell, model]).encode()).hexdigest()[:32]


class CellStore:
    """The finished cells in a folder; open in one process at a time.

    Args:
        folder: made if it does not exist.
        fresh: forget what is kept.

    Attributes:
        path: of the file.
        damaged: number of lines that were left out because they were cut short or changed.

    Raises:
        ResultsError: the folder cannot be written.
        StudyError: another process has it open.
    """

    def __init__(self, folder: Path, *, fresh: bool = False) -> None:
        make_folder(folder)
        self.path = folder / "cells.jsonl"
        self.damaged = 0
        self._answers: dict[str, str] = {}
        with writing(self.path):
            self._file: IO[str] = self.path.open("a+", encoding="utf-8", errors="replace")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._file.close()
            raise StudyError(
                f"{self.path}: another study is writing here; wait for it, or give another --out"
            ) from error
        self._file.seek(0)
        if fresh:
            self._file.truncate()
        self._read()

    def close(self) -> None:
        """Close the file; others may open it."""
        with contextlib.suppress(OSError):  # `put` has reported it
            self._file.close()

    def keys(self) -> Set[str]:
        """The keys of all answers."""
        return self._answers.keys()

    def get(self, key: str) -> str | None:
        """The answer as JSON text; None for an unknown key."""
        return self._answers.get(key)

    def put(self, key: str, what: object, answer: str) -> None:
        """Keep an answer (JSON text) with what it answers.

        Raises:
            ResultsError: it cannot be written; what was kept before is whole.
        """
        document = as_json({"key": key, "what": what, "answer": json.loads(answer)})
        try:
            self._file.write(f"{_checksum(document)} {document}\n")
            self._file.flush()
        except OSError as error:
            raise ResultsError(f"{self.path}: cannot be written: {error.strerror or error}") from error
        self._answers[key] = answer

    def _read(self) -> None:
        last = "\n"
        for last in self._file:
            checksum, _, document = last.rstrip("\n").partition(" ")
            if checksum != _checksum(document):
                self.damaged += 1
                continue
            found = json.loads(document)
            self._answers[found["key"]] = as_json(found["answer"])
        if not last.endswith("\n"):  # cut short: the next answer begins a new line
            self._file.write("\n")
            self._file.flush()


def _checksum(document: str) -> str:
    return hashlib.sha256(document.encode()).hexdigest()[:16]


# A study's result as text, CSV, JSON and picture, and the facts of every measurement.

SIGMA_COLUMNS = (
    Column("sigma_point_um", "σp µm", ".0f"),
    Column("sigma_normal_mrad", "σn mrad", ".1f"),
)
"""Noise of a row, filled by `sigma_values`."""


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
    """The values of `SIGMA_COLUMNS`, from m and rad."""
    return {"sigma_point_um": sigma_point * 1e6, "sigma_normal_mrad": sigma_normal * 1e3}


def table_lines(result: StudyResult) -> list[str]:
    """The table, a line for each row, numbers flush right."""
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
    """Facts, table and findings of all its tables."""
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
    make_folder(out)
    paths = [out / f"{result.name}.{end}" for end in ("csv", "txt", "json")]
    keys = list(dict.fromkeys(key for row in result.rows for key in row))
    with whole_file(paths[0]) as part, part.open("w", newline="", encoding="utf-8") as file:
        lines = [["" if (v := _plain(row.get(key))) is None else v for key in keys] for row in result.rows]
        csv.writer(file).writerows([keys, *lines])
    write_text(paths[1], text_of(result))
    document = json.dumps(as_document(result), indent=1, allow_nan=False, ensure_ascii=False)
    write_text(paths[2], document + "\n")
    if importlib.util.find_spec("matplotlib") is not None:
        paths.append(out / f"{result.name}.png")
        result.draw(paths[-1])
    return [*paths, *(path for more in result.more for path in write_study(more, out))]


def _shown(value: Any, form: str) -> str:
    value = _plain(value)
    if value is None:
        return "–"
    return "yes" if value is True else "no" if value is False else format(value, form)


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


# A bus that no CAN is: virtual, or faster than a real one, to measure what comes beyond the bus.


def on_any_bitrate(scene: Scene, bitrate: int) -> Scene:
    """The scene with a bit rate (bit/s) that no CAN has, and copies of its EDS files that list no bit rates."""
    assert scene.arm is not None and scene.sensor is not None
    return replace(
        scene,
        bus=replace(scene.bus, bitrate=bitrate),
        arm=replace(scene.arm, eds=_eds_for_any_bitrate(scene.arm.eds)),
        sensor=replace(scene.sensor, eds=_eds_for_any_bitrate(scene.sensor.eds)),
    )


@functools.cache
def _eds_for_any_bitrate(eds: str) -> str:
    folder = Path(tempfile.mkdtemp(prefix="canprobe-eds-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    copy = folder / eds_file(eds).name
    copy.write_bytes(re.sub(rb"(?m)^(BaudRate_\w+)=1", rb"\1=0", eds_file(eds).read_bytes()))
    return str(copy)
