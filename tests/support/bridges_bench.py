"""What every bridge adds to a cycle at 400 Hz, what it drops, and what its extra takes on disk.

A scan is recorded once, in lockstep. Its observations are then handed to each bridge at the pace of a real bus, as a
cell does it: without ever waiting. The added time is all that the cell spends on it, the collecting of the frames
included. The first second does not count.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from canprobe.cell.master.observers import Observation, Observers
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.bridges import BRIDGES
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.children import Bridges
from canprobe.cell.session.session import Session, with_bridges
from canprobe.cell.tasks.from_plan import make_task
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.real.memory import garbage_collection_paused
from canprobe.lab.studies.result import Row, StudyResult, as_document, measuring_facts, text_of

# What packages take on disk, with everything that they need and canprobe itself does not.

BASE = ("python-can", "canopen", "numpy", "scipy")


def size_of(packages: Iterable[str]) -> int:
    """Bytes of the distributions behind import names and of all that they require, as far as installed.

    Args:
        packages: import names, such as `foxglove`.
    """
    owners = metadata.packages_distributions()
    wanted = {name for package in packages for name in owners.get(package, ())}
    return sum(_bytes_of(name) for name in _closure(wanted) - _closure(BASE))


def _closure(names: Iterable[str]) -> set[str]:
    """Normalised names of installed distributions and of what they require, extras left out."""
    found: set[str] = set()
    waiting = [_normal(name) for name in names]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        try:
            requires = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue
        found.add(name)
        waiting += [_normal(re.split(r"[^\w.-]", line, maxsplit=1)[0]) for line in requires if "extra ==" not in line]
    return found


def _bytes_of(name: str) -> int:
    files = metadata.files(name) or []
    return sum(path.stat().st_size for file in files if (path := file.locate()).is_file())  # type: ignore[attr-defined]


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


# What every bridge adds to a cycle at 400 Hz, what it drops, and what its extra takes on disk.

SCENE, SECONDS, QUICK_SECONDS, WARM_UP = "cylinder", 20.0, 3.0, 400
COLUMNS = (
    "bridge", "watched", "added_p50_us", "added_p99_us", "added_max_us", "samples", "dropped", "processor_percent",
    "installed_mb",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Case:
    """One row: the bridges that are fed, and whether a viewer takes every topic."""

    bridges: tuple[str, ...]
    watched: bool = False


CASES = (
    Case(()),
    Case(("mcap",)),
    Case(("foxglove",)),
    Case(("foxglove",), watched=True),
    Case(("ros2",)),
    Case(("ros2",), watched=True),
    Case(("view",)),
    Case(("mcap", "foxglove", "ros2")),
)


def run(*, quick: bool, sweep: object) -> StudyResult:
    """Measure every bridge whose extra is installed."""
    del sweep  # one at a time: they would disturb each other
    seconds = QUICK_SECONDS if quick else SECONDS
    missing = {name: info.pip for name, info in BRIDGES.items() if info.missing}
    cases = [case for case in CASES if not missing.keys() & set(case.bridges)]
    observations = _record(seconds)
    rows = [_measure(case, observations) for case in cases]
    findings = [f"{name}: not measured, {pip}" for name, pip in missing.items()]
    worst = max(rows, key=lambda row: row["added_p99_us"])
    dropped, samples = (sum(row[key] for row in rows) for key in ("dropped", "samples"))
    findings += [
        f"99 of 100 cycles of 2500 µs take {worst['added_p99_us']:.0f} µs more at most ({worst['bridge']})",
        f"dropped in all: {dropped} of {samples} samples",
    ]
    facts = measuring_facts(quick, 1) | {"cycles": len(observations), "processors": os.cpu_count()}
    return StudyResult("bridges", rows, findings, facts, lambda path: _draw(rows, path), COLUMNS)


def _record(seconds: float) -> list[Observation]:
    """Every cycle of a scan, as an observer sees it."""
    seen: list[Observation] = []
    session = Session(load_scene(SCENE, {"task.duration_s": seconds}), RunOptions(observers=(seen.append,)))
    task = make_task(session.plan)
    with session:
        session.run(task)
    return [one for one in seen if one.measurement is not None]


def _measure(case: Case, observations: Sequence[Observation]) -> Row:
    plan = make_plan(resolve(with_bridges(load_scene(SCENE), case.bridges)))
    with (
        tempfile.TemporaryDirectory(prefix="canprobe-") as folder,
        Bridges(plan, Path(folder), virtual=False) as bridges,
        _viewer(case, bridges),
    ):
        pids = [bridge.process.pid for bridge in bridges.observers]
        before, started = sum(map(_cpu_s, pids)), perf_counter()
        added = _feed(bridges, observations)
        share = (sum(map(_cpu_s, pids)) - before) / (perf_counter() - started)
        statuses = list((bridges.end(None) or {}).values())
    failed = [status["error"] for status in statuses if status["error"] is not None]
    return {
        "bridge": " + ".join(case.bridges) or "none",
        "watched": "every topic" if case.watched else "–",
        **dict(zip(("added_p50_us", "added_p99_us"), np.percentile(added, (50, 99)).tolist(), strict=True)),
        "added_max_us": float(added.max()),
        "samples": sum(status["samples"] for status in statuses),
        "dropped": sum(status["dropped"] for status in statuses),
        "processor_percent": 100 * share if pids else None,
        "installed_mb": size_of({name for bridge in case.bridges for name in BRIDGES[bridge].packages}) * 1e-6,
        "error": failed[0] if failed else None,
    }


def _feed(bridges: Bridges, observations: Sequence[Observation]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Hand every observation over at its time; what each took (n,), µs."""
    clock, added = MonotonicClock(), []
    hub = Observers(bridges.observers) if bridges.observers else None
    write = _nothing if hub is None else hub.tap(_nothing)
    with garbage_collection_paused():
        start_ns = clock.now_ns() + 50_000_000 - observations[0].t_ns
        for observation in observations:
            clock.sleep_until_ns(start_ns + observation.t_ns)
            begun = perf_counter()
            for frame in observation.frames:
                write(*frame)
            if hub is not None and observation.measurement is not None:
                hub.cycle(observations[0].t_ns, observation.measurement, observation.command)
            added.append(perf_counter() - begun)
    return 1e6 * np.array(added[WARM_UP:])


def _nothing(_can_id: int, _data: bytes, _t_ns: int) -> None:
    """Where a run's log would take the frame."""


def _cpu_s(pid: int) -> float:
    """Processor time that a process has had, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def _viewer(case: Case, bridges: Bridges) -> Iterator[None]:
    """A process that takes every topic of the bridge and does nothing with it."""
    if not case.watched:
        yield
        return
    (bridge,) = bridges.observers
    where = re.split(r"[, ]", bridge.await_ready())[0 if bridge.name == "foxglove" else 1]
    command = [sys.executable, str(Path(__file__).with_name("bridge_viewers.py")), bridge.name, where]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL)
    try:
        assert process.stdout is not None
        process.stdout.readline()  # it is there
        yield
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def _draw(rows: Sequence[Row], path: Path) -> None:
    from canprobe.cell.results.picture import BLUE, SKY, legend, picture

    title = "Time that bridges add to a cycle of 2500 µs; watched: while a process takes every topic"
    with picture(path, title, 3.6) as figure:
        axes = figure.subplots()
        names = [row["bridge"] + (", watched" if row["watched"] != "–" else "") for row in rows]
        axes.barh(names, [row["added_p99_us"] for row in rows], color=SKY, label="99 of 100 cycles")
        axes.barh(names, [row["added_p50_us"] for row in rows], color=BLUE, label="median", height=0.5)
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("added to a cycle (µs)")
        legend(figure)


if __name__ == "__main__":  # python tests/support/bridges_bench.py [--quick] [--json]
    found = run(quick="--quick" in sys.argv, sweep=None)
    print(json.dumps(as_document(found)) if "--json" in sys.argv else text_of(found))
