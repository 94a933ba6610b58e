"""Many runs of one scene: each combination of values and seeds, on all cores; as a table, or over time."""

from __future__ import annotations

import functools
import hashlib
import html
import importlib.util
import operator
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex, TypeGuard

import numpy as np

import canprobe
from canprobe.api import run_plan
from canprobe.cell.master.options import Say, quiet
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.results.result import RunResult
from canprobe.cell.results.run_files import unit_of
from canprobe.cell.scene.load import dump_scene, load_scene, parse_scene, with_files
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.target import VIRTUAL, Target
from canprobe.cell.session.terminal import StepReport
from canprobe.errors import CanprobeError, SafetyStop, UsageError, needed_module
from canprobe.fieldbus.bus.files import make_folder, whole_file
from canprobe.lab.studies.cell_store import model_digest
from canprobe.lab.studies.result import Row
from canprobe.lab.studies.sweep import error_text, open_sweep
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    import pandas
    import xarray

SERIES = ("force_n", "kappa_per_m")
"""Columns of a log that are kept by default, where there are any."""
TRUTH = "truth."
"""Prefix of the name of a series from the plant's truth."""
_FIGURES = ("sim_time_s", "wall_time_s", "contact", "shape", "calibration")
"""Parts of a summary whose numbers are columns of the table."""


@dataclass(frozen=True, slots=True)
class RunCase:
    """A run, with everything that decides its outcome.

    Attributes:
        scene: scene as TOML.
        files: digest of the files that it names.
        seed: seed that replaces the scene's.
        series: columns of the log, or of the truth, that are kept.
        every_ms: time between two of their values.
    """

    scene: str
    files: str
    seed: int
    series: tuple[str, ...]
    every_ms: float


def measure(case: RunCase) -> dict[str, Any]:
    """Carry a case out, in a worker; whatever ends it is its outcome."""
    outcome: dict[str, Any] = {"status": "done", "reason": None, "summary": None, "series": {}, "columns": []}
    try:
        result = run_plan(_planned(case.scene, case.files).with_seed(case.seed))
    except CanprobeError as error:
        status = {SafetyStop: "stopped", UsageError: "refused"}
        outcome["status"] = next((word for kind, word in status.items() if isinstance(error, kind)), "failed")
        return outcome | {"reason": str(error), "summary": error.summary}
    except Exception as error:  # a fault of one run costs that run
        return outcome | {"status": "failed", "reason": error_text(error)}
    columns = {**result.log, **{f"{TRUTH}{name}": column for name, column in result.truth.items()}}
    series = {name: columns[name] for name in case.series if name in columns}
    return outcome | {
        "summary": result.summary,
        "series": {name: _sampled(result, column, 1e-3 * case.every_ms) for name, column in series.items()},
        "columns": sorted(columns),
    }


@functools.lru_cache(maxsize=8)
def _planned(scene: str, files: str) -> Plan:
    """The plan of a scene (TOML) whose files have a digest, kept in a worker for its next seeds."""
    return make_plan(resolve(parse_scene(scene)))


def _sampled(result: RunResult, column: Floats, every_s: float) -> Floats:
    """The values of a column that held at even distances of time from the first SYNC on."""
    t = result.log["t_s"][: len(column)] - result.log["t_s"][0]
    rows = np.searchsorted(t, np.arange(0.0, t[-1] + 1e-9, every_s) + 1e-9, side="right") - 1
    return np.asarray(column[rows], dtype=np.float64)


def run_many(
    scene: Scene | str | Path,
    vary: Mapping[str, Sequence[Any]] | None = None,
    *,
    seeds: SupportsIndex | Iterable[SupportsIndex] | None = None,
    bus: str | None = None,
    duration_s: float | None = None,
    workers: int | None = None,
    out: Path | str | None = None,
    fresh: bool = False,
    series: Sequence[str] = SERIES,
    every_ms: float = 50.0,
    progress: bool = True,
    say: Say = quiet,
) -> Runs:
    """Run every combination of values, with every seed.

    Finished runs are kept in ``out``: the same call computes what is missing, after an interrupt or a crash too. Runs
    of another canprobe are computed again. A run that fails is a row with its reason. Files that the scene names are
    copied into ``out`` before the first run, and all runs use the copies. No run writes files or draws, and the scene's
    other estimators (``shape.also``) do not compute: ``vary={"shape.also": [["ml"]]}`` asks for them.

    Args:
        scene: as for `canprobe.run`.
        vary: the values of each key, such as ``{"task.force_n": [1, 2, 3]}``. Values that belong together are
            one key, a section: ``{"object": [{"kind": "plane"}, {"kind": "sphere", "radius_mm": 40}]}``.
        seeds: number of seeds, from 0 on, or a list of them; by default the scene's.
        bus: ``direct`` or ``lockstep``; the scene's by default. Where the wire is of no interest, ``direct`` gives the
            results of a lockstep bus without delays, several times as fast.
        duration_s: duration that replaces the scene's, s.
        workers: number of processes, one for each core by default.
        out: folder of the finished runs; ``runs/many-<scene>`` by default.
        fresh: whether to forget the runs in ``out``.
        series: columns of the log to keep over time for `Runs.to_xarray`; ``truth.force_n`` is one of the truth.
        every_ms: time between two of their values, ms.
        progress: whether to show a bar on a terminal or in a notebook.
        say: called with each step.

    Returns:
        All runs, those that were finished before included.

    Raises:
        UsageError: a combination has mistakes, a list is empty, or the bus is a real one; nothing was started.
        ResultsError: ``out`` cannot be written.
        StudyError: a worker was killed, or another process uses ``out``.
    """
    given = {} if duration_s is None else {"task.duration_s": duration_s}
    base = load_scene(scene, given)
    base = Target.over(base, bus).applied_to(base)
    if base.shape is not None:
        base = load_scene(base, {"shape.also": ()})
    if (name := base.bus.interface) not in VIRTUAL:
        raise UsageError(f'run_many: runs share no bus: expected bus="direct" or "lockstep", got "{name}"')
    keys, combinations = _combinations(vary or {})
    wanted = _seeds(base, seeds)
    changes = [dict(zip(keys, values, strict=True)) for values in combinations]
    scenes = [load_scene(base, change) for change in changes]  # all are checked before anything is written
    folder = Path(out) if out is not None else Path("runs") / f"many-{base.name}"
    cases, rows = [], []
    for change, changed in zip(changes, scenes, strict=True):
        text, digest = _with_own_files(changed, folder)
        cases += [RunCase(text, digest, seed, tuple(series), float(every_ms)) for seed in wanted]
        rows += [{**change, "seed": seed} for seed in wanted]
    bar = StepReport().bar(".0f runs") if progress else None
    with open_sweep(folder, fresh=fresh, say=say, progress=bar, workers=workers) as sweep:
        outcomes = sweep.map(measure, cases)
    return Runs(base, tuple(keys), tuple(rows), tuple(outcomes), tuple(series), every_ms * 1e-3)


def _combinations(vary: Mapping[str, Sequence[Any]]) -> tuple[list[str], list[tuple[Any, ...]]]:
    plain = []
    for key, values in vary.items():
        if not _is_list(values):
            raise UsageError(f"vary: {key}: expected a list of values, got {values!r}")
        plain.append([value.item() if isinstance(value, np.generic) else value for value in values])
        if not plain[-1]:
            raise UsageError(f"vary: {key}: expected at least one value, got an empty list")
    return list(vary), list(product(*plain))


def _is_list(values: object) -> TypeGuard[Iterable[Any]]:
    """Whether it has elements; an array of numpy without dimensions has none."""
    return (
        isinstance(values, Iterable) and not isinstance(values, str | Mapping) and getattr(values, "shape", None) != ()
    )


def _seeds(scene: Scene, seeds: SupportsIndex | Iterable[SupportsIndex] | None) -> list[int]:
    if seeds is None:
        return [scene.seed]
    try:
        wanted = list(map(operator.index, seeds if isinstance(seeds, Iterable) else range(operator.index(seeds))))
    except TypeError:
        raise UsageError(f"seeds: expected a number, or a list of integers, got {seeds!r}") from None
    if not wanted:
        raise UsageError(f"seeds: expected at least one, got {seeds!r}")
    return [load_scene(scene, {"scene.seed": seed}).seed for seed in wanted]


def _with_own_files(scene: Scene, folder: Path) -> tuple[str, str]:
    """The scene as TOML that names copies of its files in a folder, and the digest of their contents."""
    saved, files = with_files(scene)
    digest = hashlib.sha256(b"".join(name.encode() + files[name] for name in sorted(files))).hexdigest()[:16]
    if not files:
        return dump_scene(scene), digest
    copies = folder / f"files-{digest}"
    make_folder(copies)
    for name, content in files.items():
        with whole_file(copies / name) as part:
            part.write_bytes(content)
    return dump_scene(parse_scene(dump_scene(saved), folder=copies)), digest


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Runs:
    """The runs of `run_many`, in the order of the combinations, seeds last.

    Attributes:
        scene: the scene of all runs.
        keys: keys that were varied.
        rows: the value of each key, and ``seed``, of each run.
        outcomes: outcome of each run: ``status`` (``done``; ``stopped`` for safety; ``refused`` by the plan;
            ``failed``), ``reason``, ``summary`` (as in ``summary.json``; None where nothing ran) and ``series``.
        series: names of the columns that were kept.
        every_s: time between two of their values, s.
    """

    scene: Scene
    keys: tuple[str, ...]
    rows: tuple[Row, ...]
    outcomes: tuple[dict[str, Any], ...]
    series: tuple[str, ...]
    every_s: float

    def table(self) -> pandas.DataFrame | list[Row]:
        """A row for each run: varied keys, seed, status, reason, version, and the figures of the summary by their path.

        Returns:
            A frame where pandas is installed, else the rows as mappings.
        """
        version = f"{canprobe.__version__}+{model_digest()}"
        rows = []
        for row, outcome in zip(self.rows, self.outcomes, strict=True):
            told = {"status": outcome["status"], "reason": outcome["reason"], "version": version}
            summary = outcome["summary"] or {}
            figures = {name: summary.get(name) for name in _FIGURES}
            rows.append({**row, **told, **dict(_numbers(figures))})
        if importlib.util.find_spec("pandas") is None:
            return rows
        import pandas

        return pandas.DataFrame(rows)

    def to_xarray(self) -> xarray.Dataset:
        """The series of all runs over ``run`` and ``time`` (s since the first SYNC), each with its unit.

        Varied keys, seed and status are coordinates of ``run``. A run that ended earlier, or failed, has NaN.

        Raises:
            UsageError: the extra `data` is missing, or no run has a column of that name.
        """
        arrays = needed_module("xarray", "data", "to_xarray needs xarray:")
        known = {name for outcome in self.outcomes for name in outcome["columns"]}
        found = [{name: np.array(s, dtype=float) for name, s in o["series"].items()} for o in self.outcomes]
        length = max((len(column) for columns in found for column in columns.values()), default=0)
        variables = {}
        for name in self.series:
            shape = next((columns[name].shape[1:] for columns in found if name in columns), None)
            if shape is None and name in SERIES:
                continue
            if shape is None and known:
                raise UsageError(f"series: no run has a column {name}; they have {', '.join(sorted(known))}")
            values = np.full((len(found), length, *(shape or ())), np.nan)
            for i, columns in enumerate(found):
                if name in columns:
                    values[i, : len(columns[name])] = columns[name]
            parts = [f"{name}_{axis}" for axis in range(values.ndim - 2)]
            variables[name] = (["run", "time", *parts], values, {"units": unit_of(name.removeprefix(TRUTH))})
        told = {**{key: [row[key] for row in self.rows] for key in (*self.keys, "seed")}}
        told["status"] = [outcome["status"] for outcome in self.outcomes]
        coordinates = {key: ("run", [v if np.isscalar(v) else str(v) for v in column]) for key, column in told.items()}
        time = ("time", self.every_s * np.arange(length), {"units": "s"})
        dataset: xarray.Dataset = arrays.Dataset(variables, {"time": time, **coordinates}, {"scene": self.scene.name})
        return dataset

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        counts = Counter(outcome["status"] for outcome in self.outcomes)
        said = [f"{self.scene.name}: {len(self)} runs, {', '.join(f'{n} {status}' for status, n in counts.items())}"]
        reasons = Counter(str(o["reason"]).partition("\n")[0] for o in self.outcomes if o["reason"])
        return "\n".join([*said, *(f"  {n} × {reason}" for reason, n in reasons.most_common(3))])

    def _repr_html_(self) -> str:
        table: Any = self.table()
        shown = table._repr_html_() if hasattr(table, "_repr_html_") else ""
        return f"<pre>{html.escape(repr(self))}</pre>{shown}"


def _numbers(part: Any, path: str = "") -> Iterable[tuple[str, float]]:
    """The numbers in a part of a summary, by their path."""
    if isinstance(part, Mapping):
        for name, value in part.items():
            yield from _numbers(value, f"{path}.{name}" if path else name)
    elif isinstance(part, list):
        for i, value in enumerate(part):
            yield from _numbers(value, f"{path}_{i}")
    elif isinstance(part, int | float):
        yield path, part
