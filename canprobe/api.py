"""The Python API: run a scene's task, or open its cell for controllers; and the functions behind the commands."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any

import numpy as np

from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.observers import AnyObserver, Observation
from canprobe.cell.master.options import DEFAULT_OPTIONS, RunOptions, Say, quiet, unread
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.results.open_cell import OpenCell
from canprobe.cell.results.result import RunResult
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import with_bridges
from canprobe.cell.session.target import Target
from canprobe.cell.session.terminal import Progress
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import UsageError, door
from canprobe.fieldbus.bus.real.adapters import interface_of

if TYPE_CHECKING:
    from can import BusABC

    from canprobe.cell.master.external_arm import ExternalArm
    from canprobe.cell.session.bus_tools import commission, emulate, monitor, scan
    from canprobe.cell.session.check import check
    from canprobe.cell.session.served import emulate_eds
    from canprobe.cell.session.up import check_joints, home, up

__getattr__, __dir__, _ = door(
    __name__,
    {
        "cell.session.bus_tools": ("commission", "emulate", "monitor", "scan"),
        "cell.session.check": ("check",),
        "cell.session.served": ("emulate_eds",),
        "cell.session.up": ("check_joints", "home", "up"),
    },
)
__all__ = ["Command", "Measurement", "Observation", "OpenCell", "RunResult", "Target", "open_cell", "run"]
__all__ += ["check", "check_joints", "commission", "emulate", "emulate_eds", "home", "monitor", "scan", "up"]


def run(
    scene: Scene | str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    bus: str | None = None,
    channel: str | Mapping[str, str] | None = None,
    bitrate: int | None = None,
    out: Path | str | None = None,
    seed: int | None = None,
    duration_s: float | None = None,
    progress: Progress | None = None,
    say: Say = quiet,
    files: bool = True,
    force: bool = False,
    observers: Sequence[AnyObserver] = (),
    bridge: Sequence[str] = (),
    early_summary: Callable[[Mapping[str, Any]], None] = unread,
    arm: ExternalArm | None = None,
) -> RunResult:
    """Run a scene's task and write its results.

    Args:
        scene: a packaged name, the path of a TOML file, or a scene from `canprobe.load_scene`.
        overrides: values that replace the scene's, such as ``{"task.force_n": 3}``; see `canprobe.load_scene`.
        bus: ``lockstep``, ``direct`` (no bus), ``socketcan`` or another interface; replaces the scene's.
        channel: replaces the scene's; ``{"can0": "vcan0", "can1": "vcan1"}`` where it names several.
        bitrate: replaces the scene's, bit/s.
        out: folder for the files; ``runs/<scene>-<time>`` by default.
        seed: seed of the emulation; replaces the scene's.
        duration_s: length of the task, s; replaces the scene's.
        progress: called with (seconds done, seconds in all).
        say: called with each step of bring-up and stop.
        files: whether to write files.
        force: whether files may replace those of an earlier run in ``out``; else a folder that is not empty is refused.
        observers: called after each cycle with its measurement, command and frames (`Observation`).
        bridge: names of bridges to other tools, besides those of the scene; see `canprobe.cell.planning.bridges`.
        early_summary: called with the summary of a completed run before other estimators compute (``shape.also``) and
            pictures are drawn.
        arm: the arm of a cell with ``arm.kind = "external"``, in the place of that of the cell file.

    Returns:
        The finished run.

    Raises:
        SceneError: the scene has mistakes; nothing was started.
        PlanError: the scene does not fit; nothing was started.
        UsageError: an argument is wrong, or ``out`` is not empty; nothing was started.
        BusError: an interface or a node failed. The drives are disabled and the files written, unless no bus opened.
        SafetyStop: the cell was stopped for safety. The drives are disabled and the files written.
        ResultsError: a file could not be written, for example on a full disk. The drives are disabled.
    """
    _refuse_wrong(overrides, out, observers, bridge)
    given = {"scene.seed": seed, "task.duration_s": duration_s, "bus.interface": bus, "bus.bitrate": bitrate}
    scene = load_scene(scene, _over(overrides, given))
    resolved = with_bridges(Target.over(scene, channel=channel).applied_to(scene), bridge)
    folder = results_folder(resolved, out) if files else None
    check_free(folder, force=force)
    options = RunOptions(folder, say, observers, early_summary=early_summary, arm=arm)
    return run_plan(make_plan(resolve(resolved)), options, progress)


def sample_target(
    function: Callable[[float], float], over: str, end: float, *, lowest: float, highest: float, points: int = 201
) -> dict[str, list[tuple[float, float]]]:
    """A function as the table of ``task.force_n`` or ``task.speed_mm_s``, which plan, run and saved scene then have.

    Args:
        function: target in N or mm/s at a path in mm, or at a time in s.
        over: ``path_mm`` or ``time_s``.
        end: place up to which it is sampled, evenly from 0 on; beyond it the last value holds.
        lowest, highest: range that it must stay in.
        points: number of samples; between them the target is on straight lines.

    Raises:
        UsageError: the function leaves its range.
    """
    table = [(place, float(function(place))) for place in np.linspace(0.0, end, points).tolist()]
    for place, value in table:
        if not lowest <= value <= highest:
            raise UsageError(f"function: expected {lowest:g} to {highest:g} at {over} = {place:g}, got {value:g}")
    return {over: table}


def run_plan(plan: Plan, options: RunOptions = DEFAULT_OPTIONS, progress: Progress | None = None) -> RunResult:
    """Run the task of a plan; a plan serves for any number of runs. Progress, result and errors are those of `run`."""
    task = make_task(plan)
    with OpenCell(plan, options, task=task) as cell:
        return cell.run(cell.open_to_requests(task), _report(progress, plan.setup.task.duration_s))


def _refuse_wrong(overrides: object, out: object, observers: object, bridge: object) -> None:
    """Raise UsageError where an argument of `run` or `open_cell` has a wrong type."""
    for name, value, kinds, expected in (
        ("overrides", overrides, (Mapping, NoneType), 'values by key such as {"task.force_n": 3}'),
        ("out", out, (str, os.PathLike, NoneType), "the path of a folder"),
        ("observers", observers, (list, tuple), "a list of observers"),
        ("bridge", bridge, (list, tuple, str), "a list of names of bridges"),
    ):
        if not isinstance(value, kinds):
            raise UsageError(f"{name}: expected {expected}, got {value!r}")


def _over(overrides: Mapping[str, Any] | None, given: Mapping[str, Any]) -> dict[str, Any]:
    """The overrides, replaced by the arguments that are given."""
    return {**(overrides or {}), **{key: value for key, value in given.items() if value is not None}}


def results_folder(scene: Scene, out: Path | str | None = None) -> Path:
    """Folder of the files of `run`: ``out``, or ``runs/<scene>-<time>`` to the millisecond."""
    return Path(out) if out is not None else timed_folder(scene.name)


def timed_folder(name: str) -> Path:
    """The folder ``runs/<name>-<time>``, with the time to the millisecond."""
    return Path("runs") / f"{name}-{datetime.now():%Y%m%d-%H%M%S-%f}"[:-3]


def plan(scene: Scene | str | Path, overrides: Mapping[str, Any] | None = None) -> Plan:
    """Plan a scene without starting anything; see `canprobe.cell.planning.make.make_plan`.

    Args:
        scene, overrides: as for `run`.

    Returns:
        The plan.

    Raises:
        UsageError: there is no such scene.
        SceneError: the scene has mistakes.
        PlanError: when it does not fit; the error has every reason with its numbers, and the ways out.
    """
    return make_plan(resolve(load_scene(scene, overrides)))


def check_free(folder: Path | None, *, force: bool) -> None:
    """Refuse a folder that is not empty: results replace others only with ``force``.

    Raises:
        UsageError: when the folder is not empty, and ``force`` is False.
    """
    if folder is not None and not force and folder.is_dir() and any(folder.iterdir()):
        raise UsageError(
            f"{folder}: not empty: name another folder for the results, or let them replace those of an earlier run"
            " there with --force (force=True)"
        )


def _report(progress: Progress | None, total_s: float) -> Callable[[Measurement], None]:
    if progress is None:
        return lambda _: None
    return lambda measurement: progress(min(measurement.t_ns * 1e-9, total_s), total_s)


def open_cell(
    scene: Scene | str | Path,
    overrides: Mapping[str, Any] | None = None,
    *,
    bus: str | BusABC | None = None,
    channel: str | Mapping[str, str] | None = None,
    bitrate: int | None = None,
    out: Path | str | None = None,
    seed: int | None = None,
    say: Say = quiet,
    force: bool = False,
    observers: Sequence[AnyObserver] = (),
    bridge: Sequence[str] = (),
    rows_kept: int | None = None,
    recover: bool = False,
    to_home: bool = False,
    arm: ExternalArm | None = None,
) -> OpenCell:
    """A cell for your own controllers; leaving its block always disables the drives and closes the bus.

    Example::

        with canprobe.open_cell("free", out="runs/mine") as cell:
            result = cell.run(my_controller)
        print(result.text())

    The block is the run: when it is left, in whatever way, its result is complete and its files are written.

    Args:
        scene, overrides, channel, bitrate, seed: as for `run`.
        bus: as for `run`; or a bus of python-can, which stays open.
        out: folder for the same files as those of `run`; None writes nothing.
        say: called with each step.
        force, observers, bridge: as for `run`.
        rows_kept: number of cycles whose rows of the log are kept; by default all, about 1 KiB for each, in the folder
            where there is one. With a number the truth is not kept, and a scan is not scored.
        recover: come back after a node was switched off or reset, or the interface was down. `run` raises the error of
            the loss, and the next `run` waits for the nodes and brings them up again. A controller that says
            `resumable` is held instead where the arm stands, and goes on after `OpenCell.resume`.
        to_home: joints may be without a known zero, for `OpenCell.home`.
        arm: as for `run`.

    Returns:
        The cell; ``with`` brings it up.

    Raises:
        SceneError: the scene has mistakes; nothing was started.
        PlanError: the scene does not fit; nothing was started.
        UsageError: an argument is wrong, or ``out`` is not empty; nothing was started.
        BusError: when the block is entered: an interface or a node failed.
        SafetyStop: when the block is entered: the probe is pressed.
        ResultsError: when the block is left: a file could not be written.
    """
    _refuse_wrong(overrides, out, observers, bridge)
    opened = None if bus is None or isinstance(bus, str) else bus
    interface = bus if opened is None else interface_of(opened) or "virtual"
    given = {"scene.seed": seed, "bus.interface": interface, "bus.bitrate": bitrate}
    scene = load_scene(scene, _over(overrides, given))
    resolved = with_bridges(Target.over(scene, channel=channel).applied_to(scene), bridge)
    folder = Path(out) if out is not None else None
    check_free(folder, force=force)
    options = RunOptions(folder, say, observers, rows_kept, recover=recover, to_home=to_home, bus=opened, arm=arm)
    return OpenCell(make_plan(resolve(resolved)), options)
