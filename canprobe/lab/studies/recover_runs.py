"""Runs of study `faults --recover`: a cell in lockstep that loses nodes or its bus, and what comes of it.

The score looks at the emulated nodes and the plant, not at what the master believes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import MASTER_NODE_ID, Plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.free_and_listen import HoldTask
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import CanprobeError, InterfaceError
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.cia402 import DriveState, known_state
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, SYNC_ID, Frame
from canprobe.lab.studies.recover_cases import BOOTING, END_S, REPLUG, SCENES, STALL, Outage, RecoverCase

HELD_S = 0.25
"""Time of the hold before motion is asked for."""
SETTLED_S = 0.5
"""Time of the work after the last outage, and after motion was asked for: what is lost is noticed within 0.2 s."""
SLACK_S = 1.0
"""Time that a cell may take from the boot-up of a node to the hold, besides the node's SDO times."""


class WatchedDrives(Participant):
    """Looks at the drives after each SYNC: distance of target and position in the first SYNCs after each enabling.

    Args:
        nodes: all emulated nodes.

    Attributes:
        jump_counts: largest distance in those SYNCs, from the second enabling of a drive on.
        lifting: the cell takes the probe off, which is no jump.
        syncs: number of SYNCs.
        boot_ups: time of each boot-up, ns, by node.
    """

    name = "watcher of the drives"
    hears_every_sync = True
    listens = frozenset((SYNC_ID, *range(HEARTBEAT_BASE + 1, HEARTBEAT_BASE + MASTER_NODE_ID)))
    FIRST_SYNCS = 8

    def __init__(self, nodes: Sequence[SlaveNode]) -> None:
        self._ages = {
            node.node_id: (-1, 0, node) for node in nodes if node.dictionary.entries.get(0x604100) is not None
        }
        self.boot_ups: dict[int, list[int]] = {node.node_id: [] for node in nodes}
        self.jump_counts = self.syncs = 0
        self.lifting = False

    def receive(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        """Look at each drive."""
        if can_id != SYNC_ID:
            if data == b"\0":
                self.boot_ups[can_id - HEARTBEAT_BASE].append(t_ns)
            return []
        self.syncs += 1
        for node_id, (age, before, node) in self._ages.items():
            number = node.dictionary.number
            if known_state(number(0x6041)) is not DriveState.OPERATION_ENABLED:
                self._ages[node_id] = (-1, before, node)
                continue
            times = before + (age < 0)
            self._ages[node_id] = (age + 1, times, node)
            if times > 1 and age + 1 < self.FIRST_SYNCS and not self.lifting:
                self.jump_counts = max(self.jump_counts, abs(number(0x607A) - number(0x6064)))
        return []


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


class RecoverScore:
    """What is said and done in a run, and its score.

    Args:
        case: what happens.
        plan: plan of its cell.
        say: called with each step.

    Attributes:
        errors: errors that ended a controller.
        first_s: time of the first cycle of the work, from which the outages count, s; None before.
        resumes_in: cycles until motion is asked for; None where nothing is held.
    """

    def __init__(self, case: RecoverCase, plan: Plan, say: Callable[[str], None]) -> None:
        self.case, self.plan, self._say_too = case, plan, say
        self._said: list[tuple[float, str]] = []
        self.errors: list[CanprobeError] = []
        self.first_s: float | None = None
        self.resumes_in: int | None = None

    def say(self, time_s: float, text: str) -> None:
        """Note a step of the cell."""
        self._said.append((time_s, text))
        self._say_too(f"{time_s:8.3f} s  {text}")
        if text.startswith("the cell is back"):
            self.resumes_in = round(HELD_S * 1e9 / self.plan.sync.period_ns)

    def carry_out(self, session: Session, begin: Callable[[], None], now_s: Callable[[], float]) -> None:
        """Run the work in an open session, then hold, until nothing more is to be lost or the cell has ended.

        Args:
            session: the session.
            begin: called in the first cycle of the work: the outages count from then.
            now_s: present time, s.
        """

        def is_over(_: Measurement) -> bool:
            if self.first_s is None:
                self.first_s = now_s()
                begin()
            last_s = max(loss.ends_s for loss in self.case.outages) + self.first_s
            back_s = max((time for time, text in self._said if text.startswith("the cell is back")), default=0.0)
            return now_s() >= max(last_s, back_s + HELD_S) + SETTLED_S

        def after_cycle(_: Measurement) -> None:
            if self.resumes_in is not None:
                self.resumes_in -= 1
                if self.resumes_in <= 0:
                    self.resumes_in = None
                    session.resume()

        task = HoldTask() if self.case.work == "hold" else make_task(self.plan)
        for controller in (task, *(HoldTask() for _ in range(len(self.case.outages) + 1))):
            try:
                session.run(ending(controller, is_over), after_cycle)
                if is_over(Measurement(0, 0)):
                    break
            except CanprobeError as error:
                self.errors.append(error)
                if self._said[-1][1].startswith("not back") or error.exit_status == 1:
                    break  # it ended for good, or somebody has to look

    def outcome(
        self,
        boot_ups: Mapping[int, Sequence[float]],
        times_s: Sequence[float],
        syncs: int,
        forces: Sequence[tuple[float, float]],
        jump_counts: int,
    ) -> dict[str, Any]:
        """What came of it, and what failed.

        Args:
            boot_ups: times of all boot-ups, s, by node.
            times_s: times of the log.
            syncs: number of SYNCs on the bus.
            forces: force of the plant: (time, s; force, N).
            jump_counts: largest distance of target and position after an enabling, counts.
        """
        limit = self.plan.setup.limits.force_max
        lost = [time for time, text in self._said if text.startswith("lost: ")]
        back = [time for time, text in self._said if text.startswith("the cell is back")]
        calm = [force for time, force in forces if not self._reacts(time, lost)]
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

    def _reacts(self, time_s: float, lost_s: Sequence[float]) -> bool:
        """Whether an outage has begun, and the cell has not stopped: how far the force rises then, `faults` judges."""
        begun = [(self.first_s or 0.0) + loss.after_s for loss in self.case.outages]
        return any(begin <= time_s < min((t for t in lost_s if t >= begin), default=begin) for begin in begun)

    def _late_s(
        self, since_s: float, lost_s: float, back_s: float, boot_ups: Mapping[int, Sequence[float]]
    ) -> tuple[float, float]:
        """Time from the return of what was lost to the hold, and how long it may be, s.

        That is a second and the SDO times of the nodes. The cell begins to come back when it has stopped, which may
        take as long again as its nodes may take to stop; a node that has booted is not waited for.
        """
        first_s = self.first_s or 0.0
        begun = [o for o in self.case.outages if first_s + o.after_s < back_s and first_s + o.ends_s > since_s]
        ready_s = [lost_s, *(self._ready_s(loss, boot_ups) for loss in begun)]
        booted = bool(begun) and all(loss.name in BOOTING for loss in begun)
        stops_s = 0.0 if booted else 2 * self.plan.setup.bring_up.stop_s
        return back_s - max(ready_s), SLACK_S + stops_s + self._sdo_s(lost_s, back_s)

    def _sdo_s(self, lost_s: float, back_s: float) -> float:
        """Time of the SDO transfers of the last bring-up between a loss and the return, s."""
        said = [(time, text) for time, text in self._said if lost_s <= time <= back_s]
        begin = [time for time, text in said if text.startswith("identify and configure")]
        end = [time for time, text in said if text.startswith("start all nodes")]
        return end[-1] - begin[-1] if begin and end else 0.0

    def _ready_s(self, loss: Outage, boot_ups: Mapping[int, Sequence[float]]) -> float:
        """Time at which what was lost is there again: the end of the outage, or the boot-up behind it."""
        end_s = (self.first_s or 0.0) + loss.ends_s
        if loss.name not in BOOTING:
            return end_s
        behind = [[time for time in boot_ups[i] if time >= end_s - 1e-6] for i in loss.nodes(self.plan.node_ids)]
        return max((times[0] for times in behind if times), default=end_s)


class RecoverRun:
    """One run of the study.

    Args:
        case: what happens.
        say: called with each step.
        out: folder of the run's files; None keeps none.
    """

    def __init__(self, case: RecoverCase, say: Callable[[str], None], out: Path | None) -> None:
        self._case = case
        changes = {"bus.timed": False, "scene.figures": False, "task.duration_s": END_S + 2.0}
        plan = make_plan(resolve(load_scene(SCENES[case.work], changes)))
        self._score = RecoverScore(case, plan, say)
        self._session = session = Session(plan, RunOptions(out, self._say, recover=True))
        self._faulty = session.world.make_faulty()
        self._drives = WatchedDrives(session.world.nodes)
        session.world.participants.append(self._drives)
        session.around = self._disturbed
        self._away: list[tuple[int, int, bool]] = []
        with session:
            self._score.carry_out(session, self._begin, lambda: self._now_ns * 1e-9)

    @property
    def _now_ns(self) -> int:
        assert self._session.lockstep is not None
        return self._session.lockstep.clock.now_ns()

    def _say(self, text: str) -> None:
        self._score.say(self._now_ns * 1e-9 if self._session.lockstep is not None else 0.0, text)
        if text.startswith(("lift off", "enable the drives")):
            self._drives.lifting = text.startswith("lift off")

    def _begin(self) -> None:
        """Throw the outages."""
        for loss in self._case.outages:
            if loss.name in (REPLUG, STALL):
                begin_ns = self._now_ns + round(loss.after_s * 1e9)
                self._away.append((begin_ns, begin_ns + loss.lasts_ms * 1_000_000, loss.name == STALL))
            for node_id in loss.nodes(self._score.plan.node_ids):
                self._faulty.inject(loss.fault(node_id, loss.after_s), self._now_ns)

    def _disturbed(self, port: Port) -> Port:
        """The port of the master: it fails while its interface is down, and its calls do not return in a stall."""

        def around(name: str) -> Callable[..., Any]:
            method = getattr(port, name)

            def call(*arguments: Any) -> Any:
                for begin_ns, end_ns, stalls in self._away:
                    if begin_ns <= self._now_ns < end_ns:
                        if not stalls:
                            down = f"{port.channel}: interface is down; type: sudo ip link set {port.channel} up"
                            raise InterfaceError(down)
                        port.clock.sleep_until_ns(end_ns)
                return method(*arguments)

            return call

        for name in ("send_batch", "drain", "wait"):
            setattr(port, name, around(name))
        return port

    def outcome(self) -> dict[str, Any]:
        """What came of it, and what failed; with files, the hash of the bus log too."""
        session = self._session
        boot_ups = {node_id: [t_ns * 1e-9 for t_ns in times] for node_id, times in self._drives.boot_ups.items()}
        times_s = session.cell.log.arrays()["t_s"].tolist() if len(session.cell.log) else list[float]()
        found = self._score.outcome(boot_ups, times_s, self._drives.syncs, forces_of(session), self._drives.jump_counts)
        if session.out is not None:
            found["bus_log_sha256"] = hashlib.sha256((session.out / "bus.log").read_bytes()).hexdigest()
        return found


def run_case(case: RecoverCase, say: Callable[[str], None] = lambda _: None, out: Path | None = None) -> dict[str, Any]:
    """Carry out a run, and score it."""
    return RecoverRun(case, say, out).outcome()


def forces_of(session: Session) -> list[tuple[float, float]]:
    """Force of the plant of a finished session: (time, s; force, N)."""
    truth = session.truth
    return list(zip(truth["t_s"].tolist(), truth["force_n"].tolist(), strict=True)) if "force_n" in truth else []
