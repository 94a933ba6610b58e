"""Sweeps: many independent cells on all cores; finished cells are kept, a new start computes the rest.

A study is a module with `run(*, quick, sweep) -> StudyResult`. It names a function of the module that measures one cell
and the cells; the sweep does the rest:

    @dataclass(frozen=True, slots=True)
    class Case:
        stiffness: float
        rate_hz: int
        seeds: int

    def measure(case: Case) -> dict[str, Any]:
        return {"error": ...}                                  # plain numbers, text, lists, mappings, arrays

    def run(*, quick: bool, sweep: Sweep) -> StudyResult:
        cases = [Case(k, 400, 4 if quick else 40) for k in STIFFNESSES]
        answers = sweep.map(measure, cases, model=("mechanics/touch", "cell/plant", "lab/studies/my_study.py"))
        costs = sweep.time(measure_cost, settings)             # one at a time, alone, on this machine
        ...
        return StudyResult("my_study", rows, findings(rows), measuring_facts(quick, 40), partial(draw, rows))

Answers come in the order of the cells and as JSON gives them, whether they were computed now or earlier: tuples
and arrays are lists, keys of mappings are text. The cell holds all that decides an answer (parameters, seeds). `model`
names the files and folders of the package behind it (all of them by default): when one of them changes, its cells
are computed again.
"""

from __future__ import annotations

import importlib
import json
import multiprocessing
import os
import platform
import sys
import traceback
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, closing, contextmanager
from functools import partial
from multiprocessing.process import BaseProcess
from pathlib import Path
from time import perf_counter
from types import ModuleType
from typing import Any

from canprobe.cell.session.terminal import Progress
from canprobe.errors import StudyError
from canprobe.fieldbus.bus.real.processor import BLAS_THREADS
from canprobe.fieldbus.bus.system import system
from canprobe.lab.studies.cell_store import CellStore, as_json, cell_key, model_digest
from canprobe.lab.studies.result import Say, StudyResult

Opener = Callable[[], AbstractContextManager[Executor]]
_GRACE_S = 1.0
"""Time in which workers end by themselves: a run catches SIGTERM, stops, and its worker continues."""


class Sweep:
    """Computes the cells of a study, and keeps them.

    Args:
        executor: opens any `concurrent.futures` executor; called when there are cells to compute.
        store: store of the finished cells.
        say: called with each step.
        progress: called after each cell.

    Attributes:
        folder: folder of the store, for files that a study publishes besides its table.
    """

    def __init__(self, executor: Opener, store: CellStore, *, say: Say, progress: Progress | None = None) -> None:
        self.say = say
        self.folder = store.path.parent
        self._executor, self._store, self._progress = executor, store, progress
        if store.damaged:
            say(f"{store.path}: {store.damaged} damaged lines left out; their cells are computed again")

    def map(
        self, measure: Callable[[Any], object], cells: Sequence[Any], *, model: Sequence[str] = (), machine: str = ""
    ) -> list[Any]:
        """Answers of `measure` to cells, in their order.

        Args:
            measure: a function of a module, of one cell; its answer has a JSON form.
            cells: dataclasses, or other values with a JSON form.
            model: files and folders of the package behind the answers; by default all.
            machine: this machine, for answers that hold on it only: see `time`.

        Raises:
            StudyError: a cell or a worker failed; the cells that are finished by then are kept.
        """
        parts = tuple(model)
        name, digest = f"{measure.__module__}:{measure.__qualname__}", model_digest(parts)
        keys = [cell_key(name, [cell, machine] if machine else cell, digest) for cell in cells]
        todo = {key: cell for key, cell in zip(keys, cells, strict=True) if key not in self._store.answers}
        total = len(set(keys))
        done = total - len(todo)
        if done:
            self.say(f"{done} of {total} cells are kept in {self._store.path}")

        def keep(key: str, answer: str) -> None:
            what = {"measure": name, "cell": todo[key], "model": digest, "machine": machine or None}
            self._store.put(key, what, answer)
            if self._progress is not None:
                self._progress(total - len(todo.keys() - self._store.answers.keys()), total)

        if todo:
            with process_pool(1) if machine else self._executor() as executor:
                for batch in [{key: cell} for key, cell in todo.items()] if machine else [todo]:
                    _collect(executor, partial(_compute, measure, parts, digest), batch, keep)
        return [json.loads(self._store.answers[key]) for key in keys]

    def time(self, measure: Callable[[Any], object], cells: Sequence[Any], *, model: Sequence[str] = ()) -> list[Any]:
        """Answers of cells that measure run time: one after another, alone, in one process of this machine.

        A kept answer counts on the machine that measured it only.
        """
        return self.map(measure, cells, model=model, machine=f"{platform.node()} {platform.processor()}")


@contextmanager
def open_sweep(folder: Path, *, workers: int | None = None, fresh: bool = False, **watched: Any) -> Iterator[Sweep]:
    """A sweep over the processes of this machine that keeps its cells in a folder.

    Args:
        folder: folder of `cells.jsonl`; what that holds is not computed again.
        workers: number of processes, one for each core by default.
        fresh: whether to forget the cells in the folder.
        watched: `say` and `progress` of the sweep.

    Raises:
        StudyError: another process uses the folder.
    """
    with closing(CellStore(folder, fresh=fresh)) as store:
        yield Sweep(partial(process_pool, workers), store, **watched)


def _compute(measure: Callable[[Any], object], parts: tuple[str, ...], model: str, cell: Any) -> str:
    """Measure a cell in the worker; what it raises becomes text there: not all exceptions are pickled."""
    if (here := model_digest(parts)) != model:
        other = f"the worker on {platform.node()} has another canprobe or numpy (model {here}, not {model})"
        raise StudyError(f"cell {as_json(cell)}: {other}")
    try:
        return as_json(measure(cell))
    except Exception as error:  # of any kind
        raise StudyError(f"cell {as_json(cell)}: {error_text(error)}") from None


def error_text(error: Exception) -> str:
    """An error and its place in the source, in a line."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({Path(frame.filename).name}:{frame.lineno})"


def _collect(
    executor: Executor, task: Callable[[Any], str], cells: Mapping[str, Any], keep: Callable[[str, str], None]
) -> None:
    """Compute cells and keep the answers as they come, also those that are ready when an exception ends it."""
    futures = {executor.submit(task, cell): key for key, cell in cells.items()}
    left = set(futures)
    try:
        for future in as_completed(futures):
            keep(futures[future], future.result())
            left.discard(future)
    except BaseException as error:
        for future in left:
            if future.done() and not future.cancelled() and future.exception() is None:
                keep(futures[future], future.result())
        if isinstance(error, BrokenProcessPool):
            raise StudyError("a worker was killed; start the study again to compute what is left") from error
        raise


@contextmanager
def process_pool(workers: int | None = None) -> Iterator[Executor]:
    """A pool of processes with one BLAS thread each, ended with the block; an exception ends it at once.

    Workers ignore Ctrl-C: this process decides. They end when this process is killed.

    Args:
        workers: number of processes; one for each core that this process may use by default.
    """
    before = set(multiprocessing.active_children())
    spawn = multiprocessing.get_context("spawn")
    pool = _DeafPool(workers or system.processors(), spawn, initializer=_begin, initargs=(os.getpid(),))
    try:
        yield pool
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        _end(set(multiprocessing.active_children()) - before)
        raise
    finally:
        pool.shutdown()


class _DeafPool(ProcessPoolExecutor):
    """Submits with SIGINT blocked: workers inherit that from their first instruction on.

    A worker that is started then does not import the script that starts it, which would start its sweep again; cells
    are measured by functions of modules.
    """

    def submit(self, fn, /, *args, **kwargs):  # type: ignore[no-untyped-def]  # as its base has it
        script, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
        try:
            with system.interrupts_blocked():
                return super().submit(fn, *args, **kwargs)
        finally:
            sys.modules["__main__"] = script


def _end(workers: Collection[BaseProcess]) -> None:
    for worker in workers:
        worker.terminate()
    until = perf_counter() + _GRACE_S
    for worker in workers:
        worker.join(max(until - perf_counter(), 0.0))
        worker.kill()
        worker.join()


def _begin(parent: int) -> None:
    """Begin a worker. Nothing in it moves, and whatever it does cannot ignore the signal."""
    os.environ.update(dict.fromkeys(BLAS_THREADS, "1"))  # before numpy is loaded
    system.end_with_parent(parent, system.KILL)


STUDIES: Mapping[str, str] = {
    "estimators": "error of the shape estimators against their run time, and over the Cramér–Rao bound",
    "regions": "whether the online estimator's 95 % regions hold the truth, over scenes drawn at random",
    "calibration": "how well forty touches calibrate an array, and whether a foreign calibration is noticed",
    "surfaces": "unknown shapes by the map, quadrics, splines and Gaussian processes; the path of exploration",
    "workprec": "error of the dynamic plant against its run time, by an explicit and an implicit integrator",
    "stability": "where the force loop settles, predicted and carried out, and how extreme cases end",
    "faults": "the true force with every kind of fault, in each task and phase, and with files that are wrong",
    "realtime": "how well the cycle keeps time on a real vcan0; needs that interface",
}
"""Measured quantity of each study, by its name. The module of that name has `run(*, quick, sweep) -> StudyResult`."""
FORMS: Mapping[str, tuple[str, str]] = {
    "faults --vcan": ("faults_vcan", "on a real vcan0: processes are killed, the link is taken down"),
    "faults --recover": ("recover", "whether a cell comes back from what it loses by chance: power, links, time"),
    "faults --recover --vcan": ("recover_vcan", "the same on a real vcan0"),
    "realtime --link": ("realtime_link", "whether a check of the link says what the next minute of the cell shows"),
    "realtime --soak": ("realtime_soak", "memory, clocks and counters of a cell that is held for half an hour"),
}
"""Other forms of a study, as they are typed: module, and measured quantity."""


def run_study(typed: str, *, quick: bool, sweep: Sweep, **chosen: Any) -> StudyResult:
    """Run a study.

    Args:
        typed: one of `STUDIES` or `FORMS`.
        quick: fewer repeats and cases.
        sweep: computes its cells.
        chosen: arguments of this study only.
    """
    name, _ = FORMS.get(typed, (typed, ""))
    study = importlib.import_module(f"canprobe.lab.studies.{name}")
    result: StudyResult = study.run(quick=quick, sweep=sweep, **chosen)
    return result
