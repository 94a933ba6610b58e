"""Runs as a LeRobotDataset v3.0: one episode a run, one row a cycle or a divisor of it, written with pyarrow.

    meta/info.json                              features, frame rate, totals
    meta/tasks.parquet                          the texts of the tasks
    meta/episodes/chunk-000/file-000.parquet    a row an episode, with its statistics
    meta/stats.json                             statistics over all episodes
    data/chunk-000/file-000.parquet             the rows, one row group an episode
    raw/episode-000000/                         the run's own files; `canprobe replay` reads them

The format has one frame rate, so `timestamp` is the row's number over it; the time of the cell stands in `t_cell_s`. A
tactile image is held until the next one, with its age. The format has no missing values, and no sample is invented: an
angle that was not measured or commanded is held, a phase is -1 where the task did not run, and an image that has not
come yet is 0 with an age of -1 s. Taxels are flat, as readers differ about statistics of two dimensions.

Source: Hugging Face LeRobot 0.6.1, `lerobot/datasets`, format v3.0.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.results.run_files import LOG, TACTILE, read_log, read_scene, read_summary, read_tactile
from canprobe.cell.rows import joint_positions
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.setup import Setup
from canprobe.errors import UsageError, needed_module
from canprobe.fieldbus.bus.files import make_folder, writing
from canprobe.mechanics.touch.pad import COUNTS_MAX

VERSION = "v3.0"
MAX_FILE_BYTES = 100_000_000
FILES_IN_CHUNK = 1000
PICTURES = {".png", ".html"}
"""Suffixes of the files of a run that are not taken along into ``raw``."""
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
SHOWN_FORCE_N = 0.0
"""Measured force above which a row counts as in contact."""
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"

Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class Feature:
    """A column of the dataset: names of its entries, and its values (rows, entries), or (rows,) for a single one."""

    names: list[str] | None
    values: NDArray[Any]

    @property
    def entry(self) -> dict[str, Any]:
        """The feature in ``info.json``."""
        shape = list(self.values.shape[1:]) or [1]
        return {"dtype": self.values.dtype.name, "shape": shape, "names": self.names}


@dataclass(frozen=True, slots=True, eq=False)
class RunRows:
    """A run as rows: its task in words, the robot, rows a second, and its features."""

    robot: str
    task: str
    seed: int
    fps: int
    features: dict[str, Feature]

    def __len__(self) -> int:
        return len(self.features["timestamp"].values)


def export_lerobot(runs: Sequence[Path | str], folder: Path | str, *, fps: int | None = None) -> None:
    """Write runs as a LeRobotDataset v3.0, one episode each.

    Args:
        runs: folders of runs, all of one arm and one array.
        folder: folder of the dataset, which must not exist.
        fps: rows a second, a whole divisor of the cycle's rate; None for the rate.

    Raises:
        UsageError: a run has no log or another arm, array or rate than the first; the log has gaps; the rate has no
            such divisor; the folder exists; or the extra `data` is missing.
        ResultsError: the dataset cannot be written; nothing of it is left.
    """
    for module in ("pyarrow", "pandas"):
        needed_module(module, "data", f"a LeRobot dataset needs {module}:")
    target, sources = Path(folder), [Path(run) for run in runs]
    if not sources:
        raise UsageError("expected folders of runs, got none")
    if target.exists():
        raise UsageError(f"{target} exists already: choose another folder, or remove it")
    part = target.with_name(f"{target.name}.part")
    try:
        with writing(target):
            shutil.rmtree(part, ignore_errors=True)
            _Dataset(part).write(sources, fps)
            os.replace(part, target)
    finally:
        shutil.rmtree(part, ignore_errors=True)


class _Dataset:
    """The dataset under way in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._rows: list[dict[str, Any]] = []
        self._tasks: list[str] = []
        self._frames = self._file = 0

    def write(self, sources: Sequence[Path], fps: int | None) -> None:
        import pyarrow as arrow
        from pyarrow import parquet

        first: RunRows | None = None
        writer = None
        for number, source in enumerate(sources):
            episode = rows_of_run(source, fps)
            first = first or episode
            _refuse_another(first, episode, sources[0], source)
            table = arrow.table(self._arrays(number, episode))
            if writer is None:
                path = self._path(DATA_PATH)
                writer = parquet.ParquetWriter(path, table.schema, compression="snappy")
            writer.write_table(table, row_group_size=len(table))
            self._note(number, episode)
            _take_files(source, self._folder / "raw" / f"episode-{number:06d}")
            if path.stat().st_size > MAX_FILE_BYTES:
                writer.close()
                writer, self._file = None, self._file + 1
        if writer is not None:
            writer.close()
        assert first is not None
        self._write_meta(first)

    def _path(self, pattern: str) -> Path:
        chunk, file = divmod(self._file, FILES_IN_CHUNK)
        path = self._folder / pattern.format(chunk_index=chunk, file_index=file)
        make_folder(path.parent)
        return path

    def _arrays(self, number: int, episode: RunRows) -> dict[str, Any]:
        """The columns of an episode as Arrow arrays, with those that number its rows."""
        import pyarrow as arrow

        if episode.task not in self._tasks:
            self._tasks.append(episode.task)
        rows = np.arange(len(episode))
        columns = {name: feature.values for name, feature in episode.features.items()}
        columns |= {
            "frame_index": rows,
            "episode_index": np.full(len(rows), number),
            "index": self._frames + rows,
            "task_index": np.full(len(rows), self._tasks.index(episode.task)),
        }
        return {
            name: arrow.array(values)
            if values.ndim == 1
            else arrow.FixedSizeListArray.from_arrays(arrow.array(values.reshape(-1)), values.shape[1])
            for name, values in columns.items()
        }

    def _note(self, number: int, episode: RunRows) -> None:
        chunk, file = divmod(self._file, FILES_IN_CHUNK)
        stats = {name: _statistics(feature.values) for name, feature in episode.features.items()}
        self._rows.append(
            {
                "episode_index": number,
                "tasks": [episode.task],
                "length": len(episode),
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": self._frames,
                "dataset_to_index": self._frames + len(episode),
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                "canprobe/seed": episode.seed,
                **{f"stats/{name}/{key}": value for name, one in stats.items() for key, value in one.items()},
            }
        )
        self._frames += len(episode)

    def _write_meta(self, first: RunRows) -> None:
        import pandas

        index = {"dtype": "int64", "shape": [1], "names": None}
        numbers = ("frame_index", "episode_index", "index", "task_index")
        features = {name: feature.entry for name, feature in first.features.items()} | dict.fromkeys(numbers, index)
        info = {
            "codebase_version": VERSION,
            "robot_type": first.robot,
            "total_episodes": len(self._rows),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_IN_CHUNK,
            "data_files_size_in_mb": MAX_FILE_BYTES // 1_000_000,
            "video_files_size_in_mb": 200,
            "fps": first.fps,
            "splits": {"train": f"0:{len(self._rows)}"},
            "data_path": DATA_PATH,
            "video_path": None,
            "features": features,
        }
        self._path("meta/info.json").write_text(json.dumps(info, indent=1), encoding="utf-8")
        stats = {name: _pooled(self._rows, name) for name in first.features}
        self._path("meta/stats.json").write_text(json.dumps(stats, indent=1), encoding="utf-8")
        tasks = pandas.DataFrame({"task_index": range(len(self._tasks))}, index=pandas.Index(self._tasks, name="task"))
        tasks.to_parquet(self._path("meta/tasks.parquet"))
        pandas.DataFrame(self._rows).to_parquet(self._path(EPISODES_PATH), index=False)


def rows_of_run(source: Path, fps: int | None = None) -> RunRows:
    """A run of a folder as rows.

    Args:
        source: folder of the run.
        fps: rows a second; None for the rate of the cycle.

    Raises:
        UsageError: see `export_lerobot`.
    """
    scene, summary = read_scene(source), read_summary(source)
    setup = resolve(scene)
    if setup.arm is None:
        raise UsageError(f"{source}: expected a run that moves an arm, got {scene.name}, which only listens")
    log = read_log(source / LOG, setup)
    rate = round(scene.cycle.rate_hz)
    every = _divisor(scene.cycle.rate_hz, fps)
    _refuse_gaps(source / LOG, log["t_s"], scene.cycle.rate_hz)
    rows = slice(None, None, every)
    kept = {name: log[name][rows] for name in ("t_s", "force_n", "phase") if name in log}
    features = dict(_arm_features(setup, log, rows))
    if "force_n" in log:
        features |= _contact_features(kept)
    if setup.array is not None and setup.array.mode != "features" and (source / TACTILE).exists():
        features |= _tactile_features(setup, kept, read_tactile(source / TACTILE, setup))
    count, used = len(kept["t_s"]), rate // every
    features["t_cell_s"] = Feature(None, kept["t_s"].astype(np.float64))
    features["timestamp"] = Feature(None, (np.arange(count) / used).astype(np.float32))
    task = scene.title or scene.name
    seed = scene.seed if summary is None else int(summary.get("seed") or 0)
    return RunRows(scene.cell.name, task, seed, used, features)


def _divisor(rate_hz: float, fps: int | None) -> int:
    rate = round(rate_hz)
    if abs(rate_hz - rate) > 1e-9:
        raise UsageError(
            f"a LeRobot dataset has a whole number of rows a second, the run has {rate_hz:g} cycles a second: record it"
            f" at a whole cycle.rate_hz, such as {rate - rate % 50 or 1}"
        )
    if fps is None:
        return 1
    if fps < 1 or rate % fps:
        fitting = ", ".join(str(rate // k) for k in range(1, 9) if rate % k == 0)
        raise UsageError(f"fps: expected a whole divisor of the {rate} cycles a second ({fitting} …), got {fps}")
    return rate // fps


def _refuse_gaps(file: Path, times: NDArray[Any], rate_hz: float) -> None:
    """Refuse a log in which cycles are missing: rows would no longer stand for their time."""
    if len(times) < 2:
        raise UsageError(f"{file}: expected at least two cycles, got {len(times)}")
    steps = np.diff(times) * rate_hz
    if (wide := np.flatnonzero(steps > 1.5)).size:
        at = int(wide[0])
        raise UsageError(
            f"{file}: {wide.size} gaps between cycles, the first of {steps[at] / rate_hz * 1e3:.1f} ms at"
            f" {times[at]:.3f} s: a row of the dataset would not stand for its time"
        )


def _arm_features(setup: Setup, log: Columns, rows: slice) -> Iterator[tuple[str, Feature]]:
    """State, action and torque of the joints; held where the cell had none."""
    joints = setup.needed_arm().model.joints
    names = [f"{joint.name}.pos" for joint in joints]
    unknown = np.full((len(log["t_s"]), len(names)), np.nan)
    q, target = (unknown if (found := joint_positions(log, name)) is None else found for name in ("q", "q_target"))
    q = _held(q, 0.0)
    yield "observation.state", Feature(names, q[rows].astype(np.float32))
    yield "action", Feature(names, _held(target, q)[rows].astype(np.float32))
    if "torque_permille" in log:
        torque = _held(log["torque_permille"], 0.0)[rows].astype(np.float32)
        yield "observation.torque", Feature([f"{joint.name}.torque_permille" for joint in joints], torque)


def _held(values: NDArray[Any], before: NDArray[Any] | float) -> NDArray[Any]:
    """Values with each NaN replaced by the last one before it, and by `before` where there is none."""
    known = ~np.isnan(values)
    last = np.maximum.accumulate(np.where(known, np.arange(len(values)).reshape(-1, *[1] * (values.ndim - 1)), -1))
    result: NDArray[Any] = np.take_along_axis(values, np.maximum(last, 0), axis=0)
    return np.where(last < 0, before, result)


def _contact_features(log: Columns) -> dict[str, Feature]:
    force = _held(log["force_n"], 0.0)
    phase = np.where(np.isnan(log["phase"]), -1, log["phase"]) if "phase" in log else np.full(len(force), -1)
    return {
        "observation.force": Feature(None, force.astype(np.float32)),
        "observation.in_contact": Feature(None, force > SHOWN_FORCE_N),
        "observation.phase": Feature(None, phase.astype(np.int64)),
    }


def _tactile_features(setup: Setup, log: Columns, tactile: Columns) -> dict[str, Feature]:
    """The taxels in kPa, their age, and moments of their image."""
    assert setup.array is not None
    times = log["t_s"]
    last = np.searchsorted(tactile["t_s"], times + 1e-9, side="right") - 1
    there = last >= 0
    taxels = tactile["taxels"].reshape(len(tactile["t_s"]), -1)
    kpa = (taxels * (setup.array.pad.full_scale_pa * 1e-3 / COUNTS_MAX)).astype(np.float32)
    if not len(kpa):
        kpa, last = np.zeros((1, taxels.shape[1]), np.float32), np.zeros(len(times), np.intp)
    image = np.where(there[:, None], kpa[np.maximum(last, 0)], np.float32(0.0))
    age = np.full(len(times), -1.0)
    age[there] = (times[there] - tactile["t_sample_s"][last[there]]).clip(0.0)
    rows, columns = tactile["taxels"].shape[1:]
    return {
        "observation.tactile": Feature([f"taxel_{r}_{c}" for r in range(rows) for c in range(columns)], image),
        "observation.tactile_age_s": Feature(None, age.astype(np.float32)),
        "observation.environment_state": _moments(setup, image, log),
    }


def _moments(setup: Setup, image: NDArray[Any], log: Columns) -> Feature:
    """Measured force, and centroid (mm), second central moments (mm²) and peak (kPa) of the image; 0 without a load."""
    assert setup.array is not None
    uv = 1e3 * setup.array.pad.uv.reshape(-1, 2)
    total = image.sum(axis=1)
    share = image / np.where(total > 0.0, total, 1.0)[:, None]
    mean = share @ uv
    second = share @ np.stack([uv[:, 0] ** 2, uv[:, 0] * uv[:, 1], uv[:, 1] ** 2], axis=1)
    second -= np.stack([mean[:, 0] ** 2, mean[:, 0] * mean[:, 1], mean[:, 1] ** 2], axis=1)
    force = _held(log["force_n"], 0.0) if "force_n" in log else np.zeros(len(image))
    values = np.column_stack([force, mean, second, image.max(axis=1)]).astype(np.float32)
    return Feature(["force_n", "u_mm", "v_mm", "uu_mm2", "uv_mm2", "vv_mm2", "peak_kpa"], values)


def _statistics(values: NDArray[Any]) -> dict[str, list[Any]]:
    """Statistics of a feature over its rows, in the format's lists."""
    rows = values.reshape(len(values), -1).astype(np.float64)
    stats = {"min": rows.min(axis=0), "max": rows.max(axis=0), "mean": rows.mean(axis=0), "std": rows.std(axis=0)}
    stats |= {name: np.quantile(rows, share, axis=0) for name, share in QUANTILES.items()}
    return {**{name: found.tolist() for name, found in stats.items()}, "count": [len(rows)]}


def _pooled(rows: Sequence[dict[str, Any]], feature: str) -> dict[str, list[Any]]:
    """Statistics over all episodes; quantiles are the mean of those of the episodes, weighted by their lengths."""
    of = {key: np.array([row[f"stats/{feature}/{key}"] for row in rows]) for key in ("min", "max", "mean", "std")}
    counts = np.array([row["length"] for row in rows], dtype=np.float64)
    weights = counts / counts.sum()
    mean = weights @ of["mean"]
    variance = weights @ (of["std"] ** 2 + (of["mean"] - mean) ** 2)
    found = {"min": of["min"].min(axis=0), "max": of["max"].max(axis=0), "mean": mean, "std": np.sqrt(variance)}
    found |= {key: weights @ np.array([row[f"stats/{feature}/{key}"] for row in rows]) for key in QUANTILES}
    return {**{key: value.tolist() for key, value in found.items()}, "count": [int(counts.sum())]}


def _refuse_another(first: RunRows, episode: RunRows, at: Path, source: Path) -> None:
    """Refuse an episode whose columns mean something else than those of the first."""
    if episode.fps != first.fps:
        raise UsageError(f"{source}: expected {first.fps} rows a second, as {at} has, got {episode.fps}: give fps")
    ours = {name: feature.entry for name, feature in first.features.items()}
    theirs = {name: feature.entry for name, feature in episode.features.items()}
    if episode.robot != first.robot or ours != theirs:
        differ = sorted(name for name in ours.keys() | theirs.keys() if ours.get(name) != theirs.get(name))
        what = f"the columns {', '.join(differ)} differ" if differ else f"its cell is {episode.robot}"
        raise UsageError(f"{source}: expected the arm and the array of {at} ({first.robot}); {what}: export them apart")


def _take_files(source: Path, folder: Path) -> None:
    """Copy the files of a run besides its pictures."""
    make_folder(folder)
    for file in sorted(source.iterdir()):
        if file.is_file() and file.suffix not in PICTURES:
            shutil.copyfile(file, folder / file.name)
