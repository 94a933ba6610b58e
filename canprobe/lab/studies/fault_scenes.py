"""The scenes of study `faults`: each is as short as it can be with all its phases, planned once in a process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.results.picture import AMBER, BLUE, GREEN, GREY, ORANGE, legend, log_scale, parts, picture
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.lab.studies.fault_cases import DRAWN_KINDS

FORCE_MAX_N = 3.0
_CLEARANCE_MM = 0.3


@dataclass(frozen=True, slots=True)
class Scenario:
    """One kind of run.

    Attributes:
        share: share of the runs.
        scene: packaged scene that it is derived from.
        rate_hz: rate of SYNC and sensor.
        duration_s: duration of the task itself.
        mode: mode of the sensor; None where the scene has no sensor.
        speed_share: share of the joints' speed limits, enough for the task: a drive refuses faster targets.
    """

    share: float
    scene: str
    rate_hz: float
    duration_s: float
    mode: str | None
    speed_share: float = 0.1


SCENARIOS: Mapping[str, Scenario] = MappingProxyType(
    {
        "listen": Scenario(0.1, "listen", 100.0, 0.2, "features"),
        "free": Scenario(0.15, "free", 100.0, 0.3, None),
        "press, features": Scenario(0.5, "press", 100.0, 0.1, "features"),
        "press, window": Scenario(0.1, "press", 200.0, 0.1, "window"),
        "cylinder": Scenario(0.15, "cylinder", 200.0, 0.2, "window", 0.35),
    }
)
"""A lower rate than 400 Hz makes a run cheaper and the reactions slower: their times are counted in cycles."""


@cache
def scenario_scene(name: str, timed: bool) -> Scene:
    """The scene of a scenario; `timed`: frames take time on the bus."""
    scenario = SCENARIOS[name]
    scene = load_scene(scenario.scene)
    task = replace(scene.task, duration_s=scenario.duration_s, clearance_mm=_CLEARANCE_MM)
    scene = replace(
        scene,
        task=task,
        bus=replace(scene.bus, timed=timed),
        cycle=replace(scene.cycle, rate_hz=scenario.rate_hz),
        limits=replace(scene.limits, force_max_n=FORCE_MAX_N, joint_speed_share=scenario.speed_share),
    )
    if scene.shape is not None:
        scene = replace(scene, shape=replace(scene.shape, also=()))
    if scene.sensor is not None:
        scene = replace(scene, sensor=replace(scene.sensor, rate_hz=scenario.rate_hz, mode=scenario.mode))  # type: ignore[arg-type]
    return scene


@cache
def scenario_plan(name: str, timed: bool) -> Plan:
    """The plan of a scenario, the same for all seeds."""
    return make_plan(resolve(scenario_scene(name, timed)))


def seeded_plan(name: str, timed: bool, seed: int) -> Plan:
    """The plan of one run."""
    plan = scenario_plan(name, timed)
    setup = plan.setup
    scene = replace(setup.scene, scene=replace(setup.scene.scene, seed=seed))
    return replace(plan, setup=replace(setup, scene=scene, seed=seed))


COLOURS = {
    "completed": (GREEN, ""),
    "stopped for safety": (AMBER, "//"),
    "bus or node failure": (BLUE, "\\\\"),
    "bring-up refused": (GREY, "xx"),
}
"""Colour and hatch of each outcome; the others, `hang` and `crash`, are failures."""
BIN_N, FEW = 0.05, 20


def draw_faults(runs: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw how the runs with each kind of fault ended, and the true force over all runs."""
    failed = sum(bool(one["failures"]) for one in runs)
    title = (
        f"How {len(runs)} runs with random faults of nodes and links ended; in brackets: runs with the fault\n"
        f"{failed} failed: they hung or crashed, or force, motion, power or log were not as promised"
    )
    of_kind = {kind: [one["outcome"] for one in runs if kind in one["kinds"]] for kind in DRAWN_KINDS}
    found = {f"{kind} ({len(ends)})": ends for kind, ends in of_kind.items() if ends}
    forces = [one["force_max_n"] for one in runs if one["force_bound_n"] is not None]
    with picture(path, title, 4.6) as figure:
        sides = parts(figure, 1, 2)
        left, right = (part.subplots() for part in sides)
        start = np.zeros(len(found))
        for outcome, (colour, hatch) in COLOURS.items():
            shares = np.array([ends.count(outcome) / len(ends) for ends in found.values()])
            if shares.any():
                left.barh(list(found), shares, left=start, color=colour, hatch=hatch, edgecolor="white", label=outcome)
            start += shares
        left.invert_yaxis()
        left.grid(visible=False, axis="y")
        left.set(xlabel="share of the runs with this fault", xlim=(0, 1))
        if forces:
            low, high = BIN_N * np.floor(min(forces) / BIN_N), max(*forces, FORCE_MAX_N) + BIN_N
            counts, *_ = right.hist(forces, np.arange(low, high + BIN_N, BIN_N).tolist(), color=BLUE)
            if np.max(counts) > FEW:
                log_scale(right, "y")
                right.set_ylim(bottom=0.8)
            else:
                right.yaxis.set_major_locator(MaxNLocator(integer=True))
        right.axvline(FORCE_MAX_N, color=ORANGE, label=f"limit {FORCE_MAX_N:g} N")
        right.set(xlabel="highest true force of a run that presses (N)", ylabel="runs")
        for part in sides:
            legend(part)


def draw_ends(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the time that the master took to end, by the fault on vcan0."""
    kinds = list(dict.fromkeys(row["fault"] for row in rows))
    title = (
        "How long the master took to end after processes were killed or stopped, or the link failed, on vcan0\n"
        "failed: it hung, or nodes moved or were enabled afterwards"
    )
    with picture(path, title, 1.8 + 0.25 * len(kinds)) as figure:
        axes = figure.subplots()
        for colour, mark, label, failed in ((BLUE, "o", "no failure", False), (ORANGE, "X", "failed", True)):
            some = [row for row in rows if bool(row["failures"]) == failed]
            places = [kinds.index(row["fault"]) for row in some]
            axes.plot([row["ended_s"] for row in some], places, mark, color=colour, label=label)
        axes.set_yticks(range(len(kinds)), kinds)
        axes.set(xlabel="from the fault to the end of the master (s)", xlim=(0, None), ylim=(len(kinds) - 0.5, -0.5))
        legend(figure)
