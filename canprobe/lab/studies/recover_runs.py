"""Runs of study `recover`: a cell in lockstep that loses nodes or its bus, as drawn from a seed, and what comes of it.

What is lost: power of a node, its link (bus-off), SYNC, heartbeats, its state by somebody's NMT command, or the
interface of the master; one of them or two, while the arm holds, moves, presses or scans. The score looks at the
emulated nodes and the plant, not at what the master believes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from random import Random
from typing import Any

from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.free_and_listen import HoldTask
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import CanprobeError, InterfaceError
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.cia402 import DriveState, known_state
from canprobe.fieldbus.protocol.frames import SYNC_ID, Frame

SCENES = {"hold": "free", "free": "free", "press": "press", "scan": "plane"}
"""Scene of each kind of work."""
LOST = {
    "reboot": "reboot for {ms} ms",
    "bus-off": "bus-off for {ms} ms",
    "freeze": "freeze for {ms} ms",
    "sync-lost": "sync-lost for {ms} ms",
    "heartbeat-off": "heartbeat-off for {ms} ms",
    "nmt-reset": "nmt command=129",
    "nmt-preop": "nmt command=128",
}
"""Faults of a node, as text for the registry, by name."""
REPLUG = "replug"
"""The interface of the master is down for a time."""
BEGIN_S, END_S = 0.3, 3.0
"""Time of the first loss after the first cycle of the task."""
HELD_S = 0.25
SLACK_S = 1.0
"""Time that a cell may take from the return of a node to the hold, besides the node's SDO times."""


@dataclass(frozen=True, slots=True)
class Outage:
    """One thing that is lost.

    Attributes:
        name: key of `LOST`, or `REPLUG`.
        node_id: the node; 0 for the interface.
        after_s: time of the loss after the first cycle of the task.
        lasts_ms: how long it lasts.
    """

    name: str
    node_id: int
    after_s: float
    lasts_ms: int

    def __str__(self) -> str:
        who = f" of node {self.node_id}" if self.node_id else ""
        return f"{self.name}{who} at {self.after_s:g} s for {self.lasts_ms} ms"


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
    """The run of a seed."""
    rng = Random(seed)
    work = rng.choice([*SCENES])
    nodes = (*range(1, 7), *((16,) if work in ("press", "scan") else ()))
    outages = []
    after_s = rng.uniform(BEGIN_S, END_S)
    for _ in range(rng.choice((1, 1, 2))):
        name = rng.choice((*LOST, "reboot", REPLUG))
        node_id = 0 if name == REPLUG else rng.choice(nodes)
        outages.append(Outage(name, node_id, round(after_s, 4), round(10 ** rng.uniform(1.0, 3.5))))
        after_s += 10 ** rng.uniform(-3.0, 0.5)
    return RecoverCase(seed, work, tuple(outages))


def run_case(case: RecoverCase, say: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Carry out a run, and score it."""
    return RecoverRun(case, say).outcome()


class WatchedDrives(Participant):
    """Looks at the drives after each SYNC: distance of target and position in the first SYNCs after each enabling.

    Args:
        nodes: all emulated nodes.

    Attributes:
        enabled: number of times that drives were enabled.
        jump_counts: largest distance in those SYNCs, from the second enabling of a drive on.
        lifting: the cell takes the probe off, which is no jump.
    """

    name = "watcher of the drives"
    hears_every_sync = True
    listens = frozenset((SYNC_ID,))
    FIRST_SYNCS = 8

    def __init__(self, nodes: Sequence[SlaveNode]) -> None:
        self._ages = {
            node.node_id: (-1, 0, node) for node in nodes if node.dictionary.entries.get(0x604100) is not None
        }
        self.jump_counts = 0
        self.lifting = False
        self.enabled = 0

    def receive(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        """Look at each drive."""
        for node_id, (age, before, node) in self._ages.items():
            number = node.dictionary.number
            if known_state(number(0x6041)) is not DriveState.OPERATION_ENABLED:
                self._ages[node_id] = (-1, before, node)
                continue
            times = before + (age < 0)
            self.enabled += age < 0
            self._ages[node_id] = (age + 1, times, node)
            if times > 1 and age + 1 < self.FIRST_SYNCS and not self.lifting:
                self.jump_counts = max(self.jump_counts, abs(number(0x607A) - number(0x6064)))
        return []


class Work(Controller):
    """The work of a case: it ends with its own loss, or is held and goes on.

    Args:
        task: the task.
        at_cycle: called with each measurement.
        most: cycles after which it is done.
    """

    def __init__(self, task: Controller, at_cycle: Callable[[Measurement], None], most: int) -> None:
        self._task, self._at_cycle, self._left = task, at_cycle, most
        self.can_go_on = task.can_go_on
        self.went_on = 0

    def step(self, measurement: Measurement) -> Command:
        """One cycle of the task."""
        self._at_cycle(measurement)
        self._left -= 1
        command = self._task.step(measurement)
        return replace(command, done=True) if self._left <= 0 else command

    def update(self) -> None:
        """Let the task work."""
        self._task.update()

    def go_on(self, measurement: Measurement) -> None:
        """Let the task go on."""
        self.went_on += 1
        self._task.go_on(measurement)

    @property
    def lets_go(self) -> bool:  # type: ignore[override]
        """Whether the task lets go."""
        return self._task.lets_go

    def retreat(self, reason: str) -> None:
        """Let the task let go."""
        self._task.retreat(reason)


class RecoverRun:
    """One run of the study.

    Args:
        case: what happens.
        say: called with each step.
    """

    def __init__(self, case: RecoverCase, say: Callable[[str], None]) -> None:
        self._case, self._say_too, self._said = case, say, list[tuple[float, str]]()
        self._plan = make_plan(resolve(_scene(case.work)))
        self._session = Session(self._plan, RunOptions(say=self._say, recover=True))
        self._faulty = self._session.world.make_faulty()
        self._drives = WatchedDrives(self._session.world.nodes)
        self._session.world.participants.append(self._drives)
        self._session.around = self._unplugged
        self._down: list[tuple[int, int]] = []
        self._first_ns: int | None = None
        self._resumes_in: int | None = None
        self._errors: list[CanprobeError] = []
        self._run()

    @property
    def _now_ns(self) -> int:
        assert self._session.lockstep is not None
        return self._session.lockstep.clock.now_ns()

    def _say(self, text: str) -> None:
        time_s = self._now_ns * 1e-9 if self._session.lockstep is not None else 0.0
        self._said.append((time_s, text))
        self._say_too(f"{time_s:8.3f} s  {text}")
        if text.startswith(("lift off", "enable the drives")):
            self._drives.lifting = text.startswith("lift off")
        if text.startswith("the cell is back"):
            self._resumes_in = round(HELD_S * 1e9 / self._plan.sync.period_ns)

    def _run(self) -> None:
        rate_hz = 1e9 / self._plan.sync.period_ns
        works = [Work(self._task(), self._at_cycle, round((END_S + 4.0) * rate_hz))]
        works += [Work(HoldTask(), self._at_cycle, round(0.5 * rate_hz)) for _ in range(len(self._case.outages) + 1)]
        with self._session as session:
            for work in works:
                try:
                    session.run(work, self._after_cycle)
                    if not self._lies_ahead():
                        break
                except CanprobeError as error:
                    self._errors.append(error)
                    if self._has_ended(error):
                        break

    def _task(self) -> Controller:
        return HoldTask() if self._case.work == "hold" else make_task(self._plan)

    def _lies_ahead(self) -> bool:
        """Whether something is still to be lost."""
        last_s = max(loss.after_s for loss in self._case.outages)
        return self._first_ns is not None and self._now_ns < self._first_ns + last_s * 1e9

    def _has_ended(self, error: CanprobeError) -> bool:
        """Whether the error ended the cell for good, as a refusal to enable does."""
        return self._said[-1][1].startswith("not back") or "nothing is enabled" in str(error)

    def _at_cycle(self, _: Measurement) -> None:
        """Throw the outages, at the first cycle of the task."""
        if self._first_ns is not None:
            return
        self._first_ns = self._now_ns
        for loss in self._case.outages:
            begin_ns = self._now_ns + round(loss.after_s * 1e9)
            if loss.name == REPLUG:
                self._down.append((begin_ns, begin_ns + loss.lasts_ms * 1_000_000))
                continue
            words = LOST[loss.name].format(ms=loss.lasts_ms)
            head, lasts, tail = words.partition(" for ")
            lasts += tail
            self._faulty.inject(f"node {loss.node_id}: {head} at {loss.after_s} s{lasts}", self._now_ns)

    def _after_cycle(self, _: Measurement) -> None:
        if self._resumes_in is not None:
            self._resumes_in -= 1
            if self._resumes_in <= 0:
                self._resumes_in = None
                self._session.resume()

    def _unplugged(self, port: Port) -> Port:
        """The port of the master, which fails while its interface is down."""

        def failing(name: str) -> Callable[..., Any]:
            method = getattr(port, name)

            def call(*arguments: Any) -> Any:
                if any(begin <= self._now_ns < end for begin, end in self._down):
                    raise InterfaceError(f"{port.channel}: interface is down; type: sudo ip link set {port.channel} up")
                return method(*arguments)

            return call

        for name in ("send_batch", "drain", "wait"):
            setattr(port, name, failing(name))
        return port

    def outcome(self) -> dict[str, Any]:
        """What came of it, and what failed."""
        lost = [time for time, text in self._said if text.startswith("lost: ")]
        back = [(time, text) for time, text in self._said if text.startswith("the cell is back")]
        truth = self._session.truth
        force = float(max(truth["force_n"], default=0.0)) if "force_n" in truth else 0.0
        limit = self._plan.setup.limits.force_max
        ready_s = self._ready_s()
        late_s = [time - max(ready_s, begin) for begin, (time, _) in zip(lost[-1:], back[-1:], strict=False)]
        times = self._session.cell.log.arrays()["t_s"] if len(self._session.cell.log) else [0.0]
        failures = []
        if self._drives.jump_counts > 1:
            failures.append(f"a target {self._drives.jump_counts} counts beside the position at enabling")
        if len(back) < len(lost) and not self._is_refused():
            failures.append(f"it did not come back: {self._errors[-1] if self._errors else 'no error'}")
        budget_s = SLACK_S + self._plan.setup.bring_up.sdo_s + 2 * self._plan.setup.bring_up.stop_s
        failures += [f"{late:.2f} s from the last return to the hold" for late in late_s if late > budget_s]
        if any(later <= earlier for earlier, later in pairwise(times)):
            failures.append("the times of the log do not grow")
        return {
            "seed": self._case.seed,
            "work": self._case.work,
            "outages": [str(loss) for loss in self._case.outages],
            "lost": len(lost),
            "back": len(back),
            "jump_counts": self._drives.jump_counts,
            "force_max_n": force,
            "force_limit_n": limit,
            "late_s": max(late_s, default=0.0),
            "refused": self._is_refused(),
            "errors": [str(error) for error in self._errors],
            "failures": failures,
        }

    def _is_refused(self) -> bool:
        """Whether somebody has to look at the arm: a stop for safety, such as a probe that is left pressing."""
        return bool(self._errors) and self._errors[-1].exit_status == 1

    def _ready_s(self) -> float:
        """Time at which the last of the outages was over."""
        first_s = (self._first_ns or 0) * 1e-9
        return max(first_s + loss.after_s + loss.lasts_ms * 1e-3 for loss in self._case.outages)


def _scene(work: str) -> Scene:
    changes = {"bus.timed": False, "scene.figures": False, "task.duration_s": END_S + 2.0}
    return load_scene(SCENES[work], changes)


def shrink(case: RecoverCase) -> RecoverCase:
    """The case with the fewest outages that still fails; the case itself where none of them does."""
    for i in range(len(case.outages)):
        fewer = replace(case, outages=case.outages[:i] + case.outages[i + 1 :])
        if fewer.outages and run_case(fewer)["failures"]:
            return shrink(fewer)
    return case
