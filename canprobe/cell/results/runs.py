"""The folders of runs: what each holds, what differs between two, and their removal.

The folder of a run has a ``scene.toml`` that canprobe wrote, with the files that it names, and files of a run. One that
holds anything else is listed, and never removed.
"""

from __future__ import annotations

import shutil
import stat
import time
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
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


@dataclass(frozen=True, slots=True)
class RunEntry:
    """The folder of a run.

    Attributes:
        scene: content of ``scene.toml``.
        summary: content of ``summary.json``; None where a run goes on, was killed, or left one that cannot be read.
        started_s: time at which ``scene.toml`` was written, s since 1970.
        size_bytes: size of all files.
        verdict: ``done``, ``stopped`` with the reason, or why there is no summary.
        kept_for: why it is not removed; None where it may be.
    """

    folder: Path
    scene: dict[str, Any]
    summary: dict[str, Any] | None
    started_s: float
    size_bytes: int
    verdict: str
    kept_for: str | None

    def as_dict(self) -> dict[str, Any]:
        """What `canprobe runs` lists."""
        return {
            "folder": str(self.folder),
            "scene": self.scene["scene"]["name"],
            "started": time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.started_s)),
            "duration_s": None if self.summary is None else self.summary.get("sim_time_s"),
            "size_bytes": self.size_bytes,
            "verdict": self.verdict,
        }


def read_entry(folder: Path) -> RunEntry:
    """The folder of a run.

    Raises:
        UsageError: it is not the folder of a run.
    """
    saved = folder / SAVED_AS
    if folder.is_symlink() or not saved.is_file():
        raise UsageError(f"{folder}: expected the folder of a run, got one without {SAVED_AS}")
    scene = read_document(saved, _MOST_SCENE_BYTES, tomllib.loads, "the scene of a run")
    written, beside = (
        str(scene.get("written_by")).startswith("canprobe "),
        [one for one in folder.iterdir() if one != saved],
    )
    if not written or _OF_RUN.isdisjoint(one.name for one in beside):
        raise UsageError(f"{folder}: expected the folder of a run, got a scene without files of its run")
    summary, verdict = None, "no summary: killed, or it goes on"
    try:
        if (summary := read_summary(folder)) is not None:
            verdict = "done" if summary.get("completed") else f"stopped: {summary.get('stop_reason')}"
    except UsageError as error:
        verdict = str(error)
    text = saved.read_text(encoding="utf-8")
    named = {one.name for one in beside if one.is_file() and f'"{one.name}"' in text}
    others = sorted({one.name for one in beside} - _OF_RUN - named)
    stats = [one.lstat() for one in folder.rglob("*")]
    kept_for = f"holds {', '.join(others)}, which no run wrote" if others else None
    if summary is None and time.time() - max(one.st_mtime for one in stats) < _WRITING_S:
        kept_for = f"changed less than {_WRITING_S:.0f} s ago and has no summary: the run may go on"
    size = sum(one.st_size for one in stats if stat.S_ISREG(one.st_mode))
    return RunEntry(folder, scene, summary, saved.stat().st_mtime, size, verdict, kept_for)


def find_runs(folder: Path) -> list[RunEntry]:
    """The runs in a folder, the newest last; the folder of a run is one.

    Raises:
        UsageError: there is no such folder.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; expected the folder of a run, or one of runs")
    if (folder / SAVED_AS).is_file():
        return [read_entry(folder)]
    found = []
    for one in folder.iterdir():
        try:
            found.append(read_entry(one))
        except UsageError:  # something else
            continue
    return sorted(found, key=lambda entry: entry.started_s)


def compare_runs(first: RunEntry, second: RunEntry) -> dict[str, dict[str, tuple[Any, Any]]]:
    """Settings and figures that differ between two runs: both values by the name of the key."""
    parts = {"settings": (first.scene, second.scene), "figures": (first.summary or {}, second.summary or {})}
    differing = {}
    for part, documents in parts.items():
        one, other = (dict(_leaves(document)) for document in documents)
        names = [name for name in one | other if one.get(name) != other.get(name)]
        differing[part] = {name: (one.get(name), other.get(name)) for name in names}
    return differing


def _leaves(document: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names and values of a document, of which tables are a part of the name."""
    for name, value in document.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def remove_run(entry: RunEntry) -> None:
    """Remove the folder of a run.

    Raises:
        UsageError: it may go on, or holds what no run wrote.
        ResultsError: the system refuses it.
    """
    if (reason := read_entry(entry.folder).kept_for) is not None:
        raise UsageError(f"{entry.folder}: not removed: {reason}")
    with writing(entry.folder):
        shutil.rmtree(entry.folder)
