"""The folders of runs: what each holds, what differs between several, and their removal.

The folder of a run has a ``scene.toml`` that canprobe wrote, with the files that it names, and files of a run. One that
holds anything else is listed, and never removed.
"""

from __future__ import annotations

import contextlib
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from datetime import datetime
from itertools import chain
from pathlib import Path
from typing import Any

from canprobe.cell.results.run_files import read_summary
from canprobe.cell.rows import ROWS_FOLDER
from canprobe.cell.scene.load import SAVED_AS
from canprobe.cell.session.folder import LEFT_BY_RUNS
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.files import read_document, writing

_MOST_SCENE_BYTES = 1 << 20
_OF_RUN = frozenset({*LEFT_BY_RUNS, "bus.log", ROWS_FOLDER} - {SAVED_AS})
_WRITING_S = 600.0
"""A run without a summary whose files changed within this time may go on."""


def find_runs(folder: Path) -> list[dict[str, Any]]:
    """The runs in a folder, the newest last; the folder of a run is one. For their keys see `read_entry`.

    Raises:
        UsageError: there is no such folder.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; expected the folder of a run, or one of runs")
    if (folder / SAVED_AS).is_file():
        return [read_entry(folder)]
    found = []
    for one in folder.iterdir():
        with contextlib.suppress(UsageError):  # something else
            found.append(read_entry(one))
    return sorted(found, key=lambda entry: entry["started"])


def read_entry(folder: Path) -> dict[str, Any]:
    """The folder of a run.

    Returns:
        ``folder``, name of the ``scene``, local time at which it ``started``, ``duration_s`` (time of the cell, None
        without a summary), ``size_bytes`` of all files, ``verdict`` (``done``, ``stopped`` with the reason, or why
        there is no summary), and ``kept_for``: why it is not removed, None where it may be.

    Raises:
        UsageError: it is not the folder of a run.
    """
    saved = folder / SAVED_AS
    if folder.is_symlink() or not saved.is_file():
        raise UsageError(f"{folder}: expected the folder of a run, got one without {SAVED_AS}")
    scene, beside = _scene(folder), {one.name: one for one in folder.iterdir() if one != saved}
    if not str(scene.get("written_by")).startswith("canprobe ") or _OF_RUN.isdisjoint(beside):
        raise UsageError(f"{folder}: expected the folder of a run, got a scene without files of its run")
    summary, verdict = None, "no summary: killed, or it goes on"
    try:
        if (summary := read_summary(folder)) is not None:
            verdict = "done" if summary.get("completed") else f"stopped: {summary.get('stop_reason')}"
    except UsageError as error:
        verdict = str(error)
    text, stats, kept_for = saved.read_text(encoding="utf-8"), [one.lstat() for one in folder.rglob("*")], None
    named = {name for name, one in beside.items() if one.is_file() and f'"{name}"' in text}
    if others := sorted(beside.keys() - _OF_RUN - named):
        kept_for = f"holds {', '.join(others)}, which no run wrote"
    elif summary is None and datetime.now().timestamp() - max(one.st_mtime for one in stats) < _WRITING_S:
        kept_for = f"changed less than {_WRITING_S:.0f} s ago and has no summary: the run may go on"
    return {
        "folder": str(folder),
        "scene": scene["scene"]["name"],
        "started": datetime.fromtimestamp(saved.stat().st_mtime).isoformat(" ", "seconds"),
        "duration_s": None if summary is None else summary.get("sim_time_s"),
        "size_bytes": sum(one.st_size for one in stats),
        "verdict": verdict,
        "kept_for": kept_for,
    }


def compare_runs(*folders: Path) -> dict[str, dict[str, list[Any]]]:
    """Settings and figures that differ between folders of runs: the value of each by the name of the key."""
    parts = {"settings": map(_scene, folders), "figures": (read_summary(folder) or {} for folder in folders)}
    differing = {}
    for part, documents in parts.items():
        leaves = [dict(_leaves(document)) for document in documents]
        values = {name: [one.get(name) for one in leaves] for name in dict.fromkeys(chain(*leaves))}
        differing[part] = {name: of_runs for name, of_runs in values.items() if of_runs[1:] != of_runs[:-1]}
    return differing


def _scene(folder: Path) -> dict[str, Any]:
    return read_document(folder / SAVED_AS, _MOST_SCENE_BYTES, tomllib.loads, "the scene of a run")


def _leaves(document: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names and values of a document, of which tables are a part of the name."""
    for name, value in document.items():
        yield from _leaves(value, f"{prefix}{name}.") if isinstance(value, dict) else ((prefix + name, value),)


def remove_run(folder: Path) -> None:
    """Remove the folder of a run.

    Raises:
        UsageError: it is no folder of a run, may go on, or holds what no run wrote.
        ResultsError: the system refuses it.
    """
    if (reason := read_entry(folder)["kept_for"]) is not None:
        raise UsageError(f"{folder}: not removed: {reason}")
    with writing(folder):
        shutil.rmtree(folder)
