"""Overruns that a check at 400 Hz predicts for 100 to 1000 Hz, beside those of a minute at each rate.

Machines are constructed in virtual time, each from a seed: one whose single wake-ups are late, one that stands still
now and then because another process has it, and one whose work for a cycle takes long. The bus is faster than CAN, so
that it carries 1000 Hz; the drives wait for their master, and no late cycle stops the cell.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.results.picture import BLUE, INK, ORANGE, SKY, legend, picture
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.check import measure_link, options_of_check
from canprobe.cell.session.session import Session
from canprobe.fieldbus.bus.clock import Clock
from canprobe.fieldbus.bus.port import Port, TimedFrame
from canprobe.fieldbus.bus.tapped import TappedPort
from canprobe.fieldbus.protocol.frames import SYNC_ID, Frame
from canprobe.lab.studies.link_setups import LateClock
from canprobe.lab.studies.no_bus import on_any_bitrate
from canprobe.lab.studies.realtime_cases import patient
from canprobe.lab.studies.result import Column, Row

CHECKED_HZ, CHECK_S, MINUTE_S, QUICK_MINUTE_S = 400, 10.0, 60.0, 10.0
RATES_HZ = (100, 200, 400, 800, 1000)
BITRATE = 50_000_000
MACHINES, QUICK_MACHINES = 6, 3
KINDS = ("single", "still", "slow")
ENOUGH = 25
"""Late SYNCs in the check from which a share is compared: fewer are scattered by chance by more than a fifth."""
COLUMNS = (
    Column("seed", "machine"),
    Column("kind", "kind"),
    Column("rate_hz", "Hz"),
    Column("late", "late SYNCs, check", ".0f"),
    Column("predicted_percent", "predicted %", ".2f"),
    Column("seen_percent", "minute %", ".2f"),
    Column("ratio", "ratio", ".2f"),
)


@dataclass(frozen=True, slots=True)
class Machine:
    """One constructed machine.

    Attributes:
        seed: seed that it follows from.
        kind: `single`, `still` or `slow`.
        mean_ns: mean time by which a wake-up is late, mean length of a standstill, or time of the work of a cycle, ns.
        share: share of the wake-ups that are late.
        per_s: standstills in a second.
    """

    seed: int
    kind: str
    mean_ns: float
    share: float
    per_s: float

    def around(self, part: int, port: Port) -> Port:
        """The port of a master on this machine; each part of a study has other random numbers."""
        rng = Random(self.seed * 100 + part)
        clock = port.clock
        if self.kind == "single":
            clock = LateClock(clock, rng, self.share, self.mean_ns)
        elif self.kind == "still":
            clock = StandingClock(clock, rng, self.per_s, self.mean_ns)
        return MachinePort(port, clock, round(self.mean_ns) if self.kind == "slow" else 0)


def draw_machine(seed: int) -> Machine:
    """The machine of a seed; the kinds take turns."""
    rng, kind = Random(seed), KINDS[seed % len(KINDS)]
    low, high = (2e5, 2e6) if kind == "slow" else (5e5, 8e6)
    mean_ns = math.exp(rng.uniform(math.log(low), math.log(high)))
    return Machine(seed, kind, mean_ns, math.exp(rng.uniform(-4.0, -1.5)), math.exp(rng.uniform(2.0, 4.0)))


@dataclass(slots=True)
class StandingClock:
    """A clock on a machine that stands still for some times: a sleep that ends in one ends behind it.

    Attributes:
        clock: the clock behind it.
        rng: generator of the times.
        per_s: standstills in a second.
        mean_ns: their mean length.
        begin_ns, end_ns: the last standstill.
    """

    clock: Clock
    rng: Random
    per_s: float
    mean_ns: float
    begin_ns: int = 0
    end_ns: int = 0

    def now_ns(self) -> int:
        """Present time, ns."""
        return self.clock.now_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep; a standstill goes on."""
        if t_ns <= self.clock.now_ns():
            return
        while self.end_ns < t_ns:
            self.begin_ns = self.end_ns + round(self.rng.expovariate(self.per_s * 1e-9))
            self.end_ns = self.begin_ns + round(self.rng.expovariate(1.0 / self.mean_ns))
        self.clock.sleep_until_ns(self.end_ns if self.begin_ns <= t_ns else t_ns)


class MachinePort(TappedPort):
    """The port of a master on a machine with a late clock, or with much work behind the answers.

    Args:
        port: the port.
        clock: clock of the machine.
        work_ns: time that the commands of a cycle take, ns.
    """

    def __init__(self, port: Port, clock: Clock, work_ns: int) -> None:
        super().__init__(port)
        self.clock, self._work_ns = clock, work_ns

    def hear_sent(self, frames: Sequence[Frame], t_ns: int) -> None:
        """Work for the commands of a cycle."""
        if self._work_ns and len(frames) > 1 and all(can_id != SYNC_ID for can_id, _ in frames):
            self.clock.sleep_until_ns(self.clock.now_ns() + self._work_ns)

    def hear_received(self, frames: Sequence[TimedFrame]) -> None:
        """Frames that arrive take no time."""


@dataclass(frozen=True, slots=True)
class RateCase:
    """One machine, and how long it is looked at.

    Attributes:
        seed: seed of the machine.
        minute_s: length of the hold at each rate, s.
    """

    seed: int
    minute_s: float


def cases(draw: int, *, quick: bool) -> list[RateCase]:
    """The machines of a draw."""
    number, minute_s = (QUICK_MACHINES, QUICK_MINUTE_S) if quick else (MACHINES, MINUTE_S)
    return [RateCase(900 * draw + i, minute_s) for i in range(number)]


def measure_machine(case: RateCase) -> list[Row]:
    """Check a machine at one rate, and hold the cell at each rate."""
    machine = draw_machine(case.seed)
    session = Session(_plan(CHECKED_HZ), options_of_check())
    session.around = partial(machine.around, 0)
    report = measure_link(session, CHECK_S)
    late = report.figures.late_share() * report.figures.cycles
    rows: list[Row] = []
    for rate_hz in RATES_HZ:
        predicted, seen = report.verdict.overruns[float(rate_hz)], _hold(machine, rate_hz, case.minute_s)
        percents: dict[str, Any] = {"predicted_percent": 100.0 * predicted, "seen_percent": 100.0 * seen}
        ratio = predicted / seen if predicted and seen else None
        head = {"seed": case.seed, "kind": machine.kind, "rate_hz": rate_hz, "late": late}
        rows.append({**head, **percents, "ratio": ratio})
    return rows


def _plan(rate_hz: float) -> Plan:
    changes = {"cycle.rate_hz": rate_hz, "bus.timed": True, "scene.figures": False}
    return make_plan(resolve(patient(on_any_bitrate(load_scene("free", changes), BITRATE))))


def _hold(machine: Machine, rate_hz: int, seconds: float) -> float:
    """Share of the cycles that overrun while the cell holds."""
    session = Session(_plan(rate_hz), RunOptions(rows_kept=100))
    session.around = partial(machine.around, rate_hz)
    cycles = first = 0

    def hold(_: Measurement) -> Command:
        nonlocal cycles, first
        assert session.cell.cycle is not None
        if not cycles:
            first = session.cell.cycle.statistics.overruns
        cycles += 1
        return Command(done=cycles >= seconds * rate_hz)

    with session:
        session.run(hold)
    assert session.cell.cycle is not None
    return (session.cell.cycle.statistics.overruns - first) / cycles


def findings(rows: Sequence[Row]) -> list[str]:
    """How far the predictions lie from what was seen, of machines with enough late SYNCs, and of slow ones."""
    told = [row for row in rows if row["ratio"] is not None and (row["late"] >= ENOUGH or row["kind"] == "slow")]
    ratios = sorted(row["ratio"] for row in told)
    if not ratios:
        return ["no machine had late SYNCs"]
    near = sum(1 / 1.5 <= ratio <= 1.5 for ratio in ratios)
    unforeseen = sum(row["predicted_percent"] < 0.1 and row["seen_percent"] > 2.0 for row in rows)
    return [
        f"overruns at {RATES_HZ[0]} to {RATES_HZ[-1]} Hz, predicted by a check at {CHECKED_HZ} Hz: {near} of"
        f" {len(ratios)} within x 1.5 of what a minute shows, x {ratios[0]:.2f} to x {ratios[-1]:.2f}, of machines with"
        f" {ENOUGH} late SYNCs or more in the check; {unforeseen} of {len(rows)} with more than 2 % were not foreseen"
    ]


def draw_rates(rows: Sequence[Row], path: Path) -> None:
    """Predicted overruns over those of the minute, by kind."""
    with picture(path, "Overruns at other rates: predicted by a check at 400 Hz, and seen in a minute", 4.0) as figure:
        axes = figure.subplots()
        for kind, colour in zip(KINDS, (BLUE, ORANGE, SKY), strict=True):
            mine = [row for row in rows if row["kind"] == kind]
            seen = [max(0.01, row["seen_percent"]) for row in mine]
            axes.loglog(seen, [max(0.01, row["predicted_percent"]) for row in mine], "o", color=colour, label=kind)
        axes.plot([0.01, 100.0], [0.01, 100.0], color=INK, linewidth=0.8)
        axes.set(xlabel="overruns in the minute, %", ylabel="overruns predicted, %")
        legend(figure)
