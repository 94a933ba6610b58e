"""What a cell loses while it works, by chance, and the score of what comes of it: for study `faults --recover`.

What is lost, when and for how long follows from a seed: power of a node or of all nodes, the link of a node (bus-off),
its SYNC or its heartbeats, its state by itself, the interface of the master, or the master's own time; one of them or a
pair, while the arm holds, moves, presses or scans. The score looks at the emulated nodes and the plant, not at what the
master believes.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.model import MASTER_NODE_ID, Plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.free_and_listen import HoldTask
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.protocol.cia402 import POSITION, STATUSWORD, TARGET_POSITION, DriveState, known_state
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, SYNC_ID
from canprobe.fieldbus.protocol.pdo import PdoLayout
from canprobe.lab.studies.result import Say
from canprobe.lab.studies.witnessed_run import forces_of

FIRST_SYNCS = 8
"""SYNCs after each enabling of a drive in which its target is compared with its position."""
HELD_S = 0.25
"""Time of the hold before motion is asked for."""
SETTLED_S = 0.5
"""Time of the work after the last outage, and after motion was asked for: what is lost is noticed within 0.2 s."""
SLACK_S = 1.0
"""Time that a cell may take from the boot-up of a node to the hold, besides the node's SDO times."""
SCENES: Mapping[str, str] = {"hold": "free", "free": "free", "press": "press", "scan": "plane"}
"""Scene of each kind of work."""
LOST: Mapping[str, str] = {
    **{name: name for name in ("reboot", "bus-off", "freeze", "sync-lost", "heartbeat-off")},
    "nmt-reset": "nmt command=129",
    "nmt-preop": "nmt command=128",
}
"""Faults of a node in the words of the registry, by name."""
POWER, REPLUG, STALL = "power", "replug", "stall"
"""All nodes are without power; the interface of the master is down; the master itself stands still."""
BOOTING = frozenset(("reboot", "nmt-reset", POWER))
"""Outages after which a node boots."""
AT_ONCE = frozenset(("nmt-reset", "nmt-preop"))
"""Outages that have no length: the node is back at once."""
BACK = "the cell is back"
"""Beginning of the step in which a cell has come back."""
BEGIN_S, END_S = 0.3, 3.0
"""Time of the first loss after the first cycle of the task."""


@dataclass(frozen=True, slots=True)
class Outage:
    """One thing that is lost.

    Attributes:
        name: key of `LOST`, `POWER`, `REPLUG` or `STALL`.
        node_id: the node; 0 for all nodes, or the master.
        after_s: time of the loss after the first cycle of the task.
        lasts_ms: how long it lasts; 0 of `AT_ONCE`.
    """

    name: str
    node_id: int
    after_s: float
    lasts_ms: int

    @property
    def ends_s(self) -> float:
        """Time of its end after the first cycle of the task."""
        return self.after_s + self.lasts_ms * 1e-3

    def nodes(self, node_ids: Collection[int]) -> tuple[int, ...]:
        """The nodes that it takes away, of those of the cell."""
        return tuple(node_ids) if self.name == POWER else (self.node_id,) if self.node_id else ()

    def fault(self, node_id: int, after_s: float) -> str:
        """The outage of a node as text for the registry, to begin in a time."""
        words = LOST["reboot" if self.name == POWER else self.name]
        lasts = f" for {self.lasts_ms} ms" if self.lasts_ms else ""
        return f"node {node_id}: {words} at {after_s:.4f} s{lasts}"

    def __str__(self) -> str:
        who = f" of node {self.node_id}" if self.node_id else ""
        lasts = f" for {self.lasts_ms} ms" if self.lasts_ms else ""
        return f"{self.name}{who} at {self.after_s:g} s{lasts}"


@dataclass(frozen=True, slots=True)
class RecoverCase:
    """One run.

    Attributes:
        seed: seed that it follows from.
        work: what the cell does: a key of `SCENES`.
        outages: what is lost, in order.
    """

    seed: int
    work: str
    outages: tuple[Outage, ...]

    def __str__(self) -> str:
        return f"{self.work}: " + "; ".join(map(str, self.outages))


def draw_case(seed: int) -> RecoverCase:
    """The run of a seed: every other one has a pair, whose second outage begins 1 ms to 3 s after the first."""
    rng = Random(seed)
    work = rng.choice([*SCENES])
    nodes = (*range(1, 7), *((16,) if work in ("press", "scan") else ()))
    outages = []
    after_s = rng.uniform(BEGIN_S, END_S)
    for _ in range(rng.choice((1, 2))):
        name = rng.choice((*LOST, "reboot", POWER, REPLUG, STALL))
        node_id = rng.choice(nodes) if name in LOST else 0
        lasts_ms = 0 if name in AT_ONCE else round(10 ** rng.uniform(1.0, 3.5))
        outages.append(Outage(name, node_id, round(after_s, 4), lasts_ms))
        after_s += 10 ** rng.uniform(-3.0, 0.5)
    return RecoverCase(seed, work, tuple(outages))


def shrink(case: RecoverCase, run: Callable[[RecoverCase], Mapping[str, Any]]) -> RecoverCase:
    """The case with the fewest outages that still fails when it is run; the case itself where none of them does."""
    for i in range(len(case.outages)):
        fewer = replace(case, outages=case.outages[:i] + case.outages[i + 1 :])
        if fewer.outages and run(fewer)["failures"]:
            return shrink(fewer, run)
    return case


def ending(task: Controller, is_over: Callable[[Measurement], bool]) -> Controller:
    """The task, which is done when the case is over.

    Its step is replaced, as a wrapper would have to pass on all that a cell may ask of a task that is held.
    """
    step = task.step

    def step_until_over(measurement: Measurement) -> Command:
        over = is_over(measurement)
        command = step(measurement)
        return replace(command, done=True) if over else command

    task.step = step_until_over  # type: ignore[method-assign]
    return task


class RecoverRun(ABC):
    """One run: its session, what is said and done in it, and its score.

    Args:
        case: what happens.
        changes: changes of the scene of its work.
        out: folder of the run's files.
        say: called with each step.

    Attributes:
        case, plan: what happens, and the plan of the cell.
        session: the session, which whoever carries the run out opens and closes.
        errors: errors that ended a controller.
        first_s: time of the first cycle of the work, from which the outages count, s; 0 before.
    """

    def __init__(self, case: RecoverCase, changes: Mapping[str, Any], out: Path, say: Say) -> None:
        self.case, self._out, self._say = case, out, say
        lasting = {"outputs.figures": False, "task.duration_s": END_S + 2.0}  # longer than anything is lost
        scene = load_scene(SCENES[case.work], {**lasting, **changes})
        self.session = Session(scene, RunOptions(out, self._note, recover=True))
        self.plan = self.session.plan
        self.errors: list[CanprobeError] = []
        self.first_s = 0.0
        self._said: list[tuple[float, str]] = []
        self._resumes_in = math.inf
        """Cycles until motion is asked for; infinite where nothing is held."""

    def now_s(self) -> float:
        """Time since the beginning of the log, s; 0 before."""
        time_s = self.session.steps.time_s
        return 0.0 if time_s is None else time_s()

    @abstractmethod
    def lose(self) -> None:
        """Let the outages happen at their times; called in the first cycle of the work."""

    def _note(self, text: str) -> None:
        """Note a step of the cell."""
        time_s = self.now_s()
        self._said.append((time_s, text))
        self._say(f"{time_s:8.3f} s  {text}")
        if text.startswith(BACK):
            self._resumes_in = round(HELD_S * 1e9 / self.plan.sync.period_ns)

    def _times_of(self, step: str) -> list[float]:
        """Times at which steps were noted that begin with some words, s."""
        return [time_s for time_s, text in self._said if text.startswith(step)]

    def carry_out(self) -> None:
        """Run the work in the open session, then hold, until nothing more is to be lost or the cell has ended."""
        task = HoldTask() if self.case.work == "hold" else make_task(self.plan)
        for controller in (task, *(HoldTask() for _ in range(len(self.case.outages) + 1))):
            try:
                self.session.run(ending(controller, self.is_over), self._ask_for_motion)
                if self.is_over(Measurement(0, 0)):
                    break
            except CanprobeError as error:
                self.errors.append(error)
                if self._said[-1][1].startswith("not back") or error.exit_status == 1:
                    break  # it ended for good, or somebody has to look

    def is_over(self, _: Measurement) -> bool:
        """Whether all outages and returns are `SETTLED_S` ago; asked in each cycle."""
        if not self.first_s:
            self.first_s = self.now_s()
            self.lose()
        last_s = self.first_s + max(loss.ends_s for loss in self.case.outages)
        back_s = max(self._times_of(BACK), default=0.0)
        return self.now_s() >= max(last_s, back_s + HELD_S) + SETTLED_S

    def _ask_for_motion(self, _: Measurement) -> None:
        """Resume the work some time after the cell is back; called after each cycle."""
        self._resumes_in -= 1
        if self._resumes_in <= 0:
            self._resumes_in = math.inf
            self.session.resume()

    def outcome(self) -> dict[str, Any]:
        """What came of the finished session, and what failed: by its bus log, its log and the force of its plant."""
        boot_ups: dict[int, list[float]] = {node_id: [] for node_id in self.plan.node_ids}
        targets, jump_counts, syncs = FirstTargets(self.plan), 0, 0
        for t_ns, _, can_id, data in read_candump(self._out / "bus.log"):
            syncs += can_id == SYNC_ID
            if (jump := targets.push(can_id, data)) > jump_counts and not self._lifts(t_ns * 1e-9):
                jump_counts = jump
            if HEARTBEAT_BASE < can_id < HEARTBEAT_BASE + MASTER_NODE_ID and data == b"\0":
                boot_ups[can_id - HEARTBEAT_BASE].append(t_ns * 1e-9)
        log = self.session.cell.log
        times_s = log.arrays()["t_s"].tolist() if len(log) else list[float]()
        forces = forces_of(self.session)
        limit = self.plan.setup.limits.force_max
        lost, back = self._times_of("lost: "), self._times_of(BACK)
        begun = [self.first_s + loss.after_s for loss in self.case.outages]
        # between an outage and the stop of the cell the force may rise: how far, study `faults` judges
        reacting = [(begin, min((stop for stop in lost if stop >= begin), default=begin)) for begin in begun]
        calm = [force for time, force in forces if not any(begin <= time < stop for begin, stop in reacting)]
        force, calm_n = max((force for _, force in forces), default=0.0), max(calm, default=0.0)
        refused = bool(self.errors) and self.errors[-1].exit_status == 1
        failures = []
        if jump_counts > 1:
            failures.append(f"a target {jump_counts} counts beside the position at enabling")
        if calm_n > limit:
            failures.append(f"a force of {calm_n:.2f} N, with a limit of {limit:.2f} N")
        if len(back) < len(lost) and not refused:
            failures.append(f"it did not come back: {self.errors[-1] if self.errors else 'no error'}")
        since = [0.0, *back]
        late = [self._late_s(*times, boot_ups) for times in zip(since, lost, back, strict=False)]
        failures += [
            f"{late_s:.2f} s from the last return to the hold" for late_s, budget_s in late if late_s > budget_s
        ]
        if any(later <= earlier for earlier, later in pairwise(times_s)):
            failures.append("the times of the log do not grow")
        cut = sum(loss.name == REPLUG for loss in self.case.outages)  # a SYNC whose answers went with the interface
        if (missing := syncs - len(times_s)) > cut:
            failures.append(f"{missing} of {syncs} cycles have no row in the log")
        return {
            "seed": self.case.seed,
            "work": self.case.work,
            "outages": [str(loss) for loss in self.case.outages],
            "lost": len(lost),
            "back": len(back),
            "jump_counts": jump_counts,
            "force_max_n": force,
            "force_calm_n": calm_n,
            "force_limit_n": limit,
            "late_s": max((late_s for late_s, _ in late), default=0.0),
            "rows_lost": missing,
            "refused": refused,
            "errors": [str(error) for error in self.errors],
            "failures": failures,
        }

    def _lifts(self, time_s: float) -> bool:
        """Whether the cell takes the probe off at a time, s: that is no jump."""
        said = [text for time, text in self._said if time <= time_s and text.startswith(("lift off", "enable the"))]
        return bool(said) and said[-1].startswith("lift off")

    def _late_s(
        self, since_s: float, lost_s: float, back_s: float, boot_ups: Mapping[int, Sequence[float]]
    ) -> tuple[float, float]:
        """Time from the return of what was lost to the hold, and how long it may be, s.

        That is a second and the SDO times of the nodes. The cell begins to come back when it has stopped, which may
        take as long again as its nodes may take to stop; a node that has booted is not waited for.
        """
        first_s = self.first_s
        begun = [o for o in self.case.outages if first_s + o.after_s < back_s and first_s + o.ends_s > since_s]
        ready_s = [lost_s, *(self._ready_s(loss, boot_ups) for loss in begun)]
        booted = bool(begun) and all(loss.name in BOOTING for loss in begun)
        stops_s = 0.0 if booted else 2 * self.plan.setup.bring_up.stop_s
        return back_s - max(ready_s), SLACK_S + stops_s + self._sdo_s(lost_s, back_s)

    def _sdo_s(self, lost_s: float, back_s: float) -> float:
        """Time of the SDO transfers of the last bring-up between a loss and the return, s."""
        steps = ("identify and configure", "start all nodes")
        begin, end = ([t for t in self._times_of(step) if lost_s <= t <= back_s] for step in steps)
        return end[-1] - begin[-1] if begin and end else 0.0

    def _ready_s(self, loss: Outage, boot_ups: Mapping[int, Sequence[float]]) -> float:
        """Time at which what was lost is there again: the end of the outage, or the boot-up behind it."""
        end_s = self.first_s + loss.ends_s
        if loss.name not in BOOTING:
            return end_s
        behind = [[time for time in boot_ups[i] if time >= end_s - 1e-6] for i in loss.nodes(self.plan.node_ids)]
        return max((times[0] for times in behind if times), default=end_s)


class FirstTargets:
    """Distance of target and position in the first cycles after each enabling of a drive, from a log.

    Args:
        plan: plan of the cell.
    """

    def __init__(self, plan: Plan) -> None:
        drives = [pdo for pdo in plan.pdos if pdo.kind == "drive"]
        self._layouts: Mapping[int, tuple[int, PdoLayout]] = {p.cob_id: (p.node_id, p.layout) for p in drives}
        self._values: dict[int, dict[int, int]] = {pdo.node_id: {} for pdo in drives}
        self._ages: dict[int, tuple[int, int]] = dict.fromkeys(self._values, (-1, 0))

    def push(self, can_id: int, data: bytes) -> int:
        """Take a frame: distance of a target, counts, from the position that the drive reported before it.

        It is 0 of other frames, of later targets, and before the second enabling of the drive.
        """
        node_id, layout = self._layouts.get(can_id, (0, None))
        if layout is None or len(data) != layout.length:
            return 0
        values = self._values[node_id]
        got = {entry.index: value for entry, value in zip(layout.signals, layout.unpack(data), strict=True)}
        values.update(got)
        age, times = self._ages[node_id]
        if STATUSWORD in got:
            enabled = known_state(got[STATUSWORD]) is DriveState.OPERATION_ENABLED
            self._ages[node_id] = (age + 1, times + (age < 0)) if enabled else (-1, times)
        elif TARGET_POSITION in got and times > 1 and 0 <= age < FIRST_SYNCS and POSITION in values:
            return abs(got[TARGET_POSITION] - values[POSITION])
        return 0
