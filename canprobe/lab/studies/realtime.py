"""Study `realtime`: how well the cycle keeps time on a real SocketCAN interface, emulated nodes in a child process.

Three measurements: the whole controller at 400 Hz for minutes; a loop that does nothing, for the lateness of the
machine; and the highest rate that is held, for each mode of the sensor, with a controller that only holds the joints.
Needs a `vcan0`; `canprobe vcan --realtime -- canprobe study realtime` runs it where the kernel has none.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import process_time
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import SubFigure

from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.traffic import LAST_LOOK
from canprobe.cell.results.picture import BLUE, GREY, INK, ORANGE, SKY, legend, log_scale, parts, picture
from canprobe.cell.results.summary import percentiles
from canprobe.cell.scene.hardware import TactileModeName
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.clock import MonotonicClock, wake_lateness
from canprobe.fieldbus.bus.real.processor import MASTER_PRIORITY, realtime
from canprobe.fieldbus.bus.real.socketcan import check_interface
from canprobe.fieldbus.tools.link import AnswerFigures, LinkFigures, LinkLimits, LinkVerdict, judge_link
from canprobe.lab.studies import vcan_cells
from canprobe.lab.studies.result import Row, Say, StudyResult
from canprobe.lab.studies.sweep import Sweep

RATE_HZ = 400.0
RATES_HZ = (100, 200, 250, 400, 500, 625, 1000)
MODES: tuple[TactileModeName, ...] = ("features", "window", "image")
HELD_PER_10000 = 1.0
"""Most overruns of a rate that counts as held."""
COLUMNS = (
    "case", "sensor", "rate_hz", "held_hz", "cycles", "overruns_per_10000", "missed_pdos", "lateness_p50_us",
    "lateness_p99_us", "lateness_max_us", "response_p50_us", "response_p99_us", "compute_p50_us", "compute_p99_us",
    "latency_p50_us", "latency_p99_us", "processor_percent", "verdict", "ended",
)  # fmt: skip


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Measure; minutes of real time, or half a minute with `quick`."""
    check_interface(vcan_cells.CHANNEL)
    say = sweep.say
    scan_s, bare_s, hold_s = (4.0, 1.0, 1.0) if quick else (300.0, 100.0, 10.0)
    say(f"the whole controller at 400 Hz, {scan_s:g} s")
    measured = [measure_scan(scan_s)]
    say(f"a loop at 400 Hz that does nothing, {bare_s:g} s")
    measured.append(measure_bare(bare_s))
    for mode in MODES:
        measured += _climb(mode, hold_s, (400,) if quick else RATES_HZ, say)
    facts = vcan_cells.vcan_facts(quick, 1) | {"controller": "scan of cylinder; hold elsewhere"}
    draw = partial(draw_realtime, measured)
    return StudyResult("realtime", [_row(m) for m in measured], findings(measured), facts, draw, COLUMNS)


def _climb(mode: TactileModeName, seconds: float, rates_hz: Iterable[float], say: Say) -> Iterator[Measured]:
    """Rising rates, until one loses a tenth of its cycles."""
    for rate_hz in rates_hz:
        say(f"hold with {mode} at {rate_hz:g} Hz, {seconds:g} s")
        held = measure_hold(mode, rate_hz, seconds)
        yield held
        if held.ended or held.held_hz < 0.9 * rate_hz:
            return


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A case, and the times of its cycles, ns; empty where a time was not measured.

    Attributes:
        case, sensor: name of the case, and mode of the sensor.
        rate_hz: requested rate of SYNC.
        lateness_ns: time of each SYNC behind its deadline.
        seconds: time from the first SYNC to the last.
        response_ns: time from the last TPDO to the RPDOs in every fifth cycle.
        compute_ns: that time and the controller's work after the RPDOs.
        latency_ns: time from a SYNC to the last of the drives' TPDOs, where all answered.
        missed: number of TPDOs that did not come in their cycle.
        processor_share: processor time of the master's process over `seconds`; None where it cannot be measured.
        ended: reason of an early end.
    """

    case: str
    sensor: str
    rate_hz: float
    lateness_ns: Sequence[int]
    seconds: float
    response_ns: Sequence[int] = ()
    compute_ns: Sequence[int] = ()
    latency_ns: Sequence[int] = ()
    missed: int = 0
    processor_share: float | None = None
    ended: str = ""

    @property
    def period_ns(self) -> int:
        """Requested period of SYNC, ns."""
        return round(1e9 / self.rate_hz)

    @property
    def overruns(self) -> int:
        """Number of cycles woken more than half a period late."""
        return sum(late_ns > self.period_ns // 2 for late_ns in self.lateness_ns)

    @property
    def cycles(self) -> int:
        """Number of cycles."""
        return len(self.lateness_ns)

    @property
    def held_hz(self) -> float:
        """Held rate, cycles per second."""
        return (self.cycles - 1) / self.seconds if self.seconds > 0 else 0.0

    @property
    def per_10000(self) -> float:
        """Overruns in 10 000 cycles."""
        return 1e4 * self.overruns / max(1, self.cycles)


def measure_scan(seconds: float) -> Measured:
    """The scene `cylinder` with servo and estimator."""
    return _measured("whole controller", _scene({"task.duration_s": seconds}), make_task)


def measure_bare(seconds: float) -> Measured:
    """A loop that wakes at every deadline and does nothing: the machine's own lateness."""
    clock, period_ns = MonotonicClock(), round(1e9 / RATE_HZ)
    with realtime(MASTER_PRIORITY, lambda _: None):  # the first case has reported missing permissions
        first_ns = clock.now_ns() + period_ns
        lateness = wake_lateness(clock, period_ns, round(seconds * RATE_HZ))
        held_s = (clock.now_ns() - first_ns) * 1e-9
    return Measured("bare clock", "none", RATE_HZ, lateness, held_s)


def measure_hold(mode: TactileModeName, rate_hz: float, seconds: float) -> Measured:
    """The joints hold their position, at any rate."""
    with vcan_cells.served(_scene()):  # its nodes take their rates from the master
        return _measured("hold", holding_scene(mode, rate_hz), lambda _: Hold(int(seconds * rate_hz)))


def holding_scene(mode: TactileModeName, rate_hz: float) -> Scene:
    """Six drives and the sensor at half their rate; the session starts none of them."""
    scene = vcan_cells.on_any_bitrate(vcan_cells.with_real_nodes(_scene()))
    assert scene.sensor is not None
    sensor = replace(scene.sensor, mode=mode, rate_hz=rate_hz / 2)
    return replace(scene, cycle=replace(scene.cycle, rate_hz=rate_hz), sensor=sensor)


def _scene(changes: Mapping[str, Any] = MappingProxyType({})) -> Scene:
    """The scene `cylinder`, patient; with real-time priority and locked memory where they are permitted."""
    return vcan_cells.patient(load_scene("cylinder", {**vcan_cells.ON_VCAN, "cycle.realtime": True, **changes}))


class Hold(Controller):
    """Hold the joints at their first position, for some cycles."""

    def __init__(self, cycles: int) -> None:
        self._cycles = cycles
        self._q: Any = None

    def step(self, measurement: Measurement) -> Command:
        if self._q is None:
            self._q = measurement.q
        self._cycles -= 1
        return Command(q_target=self._q, done=self._cycles <= 0)


def _measured(case: str, scene: Scene, make: Callable[[Plan], Controller]) -> Measured:
    """Run a controller to its end; the run writes its files, as those of users do."""
    assert scene.sensor is not None
    ended, used_s, latency_ns, missed = "", 0.0, list[int](), 0
    with tempfile.TemporaryDirectory() as folder:
        session = Session(scene, RunOptions(Path(folder)))

        def note_latency(_: Measurement) -> None:
            nonlocal missed
            drives = session.cell.drives
            assert drives is not None
            if drives.missed == missed:  # all have answered
                latency_ns.append(drives.answer_ns)
            missed = drives.missed

        try:
            with session:
                used_s = process_time()
                session.run(make(session.plan), note_latency)
        except CanprobeError as error:
            if not session.opened:
                raise
            ended = str(error)
    cycle, drives = session.cell.cycle, session.cell.drives
    assert cycle is not None and drives is not None
    times, seconds = cycle.statistics, cycle.t_ns * 1e-9
    return Measured(
        case, scene.sensor.mode, scene.cycle.rate_hz, times.period_error_ns, seconds, times.response_ns,
        times.compute_ns, latency_ns, drives.missed, processor_share(used_s, seconds), ended,
    )  # fmt: skip


def processor_share(used_before_s: float, passed_s: float) -> float | None:
    """Processor share since `process_time` gave `used_before_s`; None in a guest, which counts whole ticks."""
    if os.environ.get("CANPROBE_VCAN") == "guest" or passed_s <= 0:
        return None
    return (process_time() - used_before_s) / passed_s


def _row(m: Measured) -> Row:
    times_ns = {"lateness": m.lateness_ns, "response": m.response_ns, "compute": m.compute_ns, "latency": m.latency_ns}
    return {
        **{name: getattr(m, name) for name in ("case", "sensor", "rate_hz", "held_hz", "cycles", "overruns")},
        "overruns_per_10000": m.per_10000,
        "missed_pdos": m.missed,
        **{f"{name}_{what}_us": us for name, ns in times_ns.items() for what, us in percentiles(ns).items()},
        "processor_percent": None if m.processor_share is None else 100 * m.processor_share,
        "verdict": str(_verdict(m).fitness),
        "ended": m.ended,
    }


def _verdict(m: Measured) -> LinkVerdict:
    """The verdict of `canprobe check` on the cycles of a case: SYNCs that are late, and answers that were missed."""
    answers = AnswerFigures(0, m.cycles, tuple(sorted(m.latency_ns)), 0, m.missed, (1,) * m.missed)
    figures = LinkFigures(m.period_ns, sorted(m.lateness_ns), round(LAST_LOOK * m.period_ns), (answers,))
    return judge_link(figures, LinkLimits())


def findings(measured: list[Measured]) -> list[str]:
    """The figures beside the goals."""
    scan, bare = measured[:2]
    lines = [
        f"whole controller at {scan.rate_hz:g} Hz for {scan.seconds:.0f} s: {scan.per_10000:.1f} overruns"
        f" in 10 000 cycles (goal 1), {scan.held_hz:.1f} cycles a second held",
        f"a loop at {bare.rate_hz:g} Hz that does nothing: {bare.per_10000:.1f} overruns in 10 000 cycles, the"
        " machine's own",
    ]
    if len(scan.compute_ns):
        of_period = 100.0 / scan.period_ns
        response, whole = (of_period * np.percentile(t, 99) for t in (scan.response_ns, scan.compute_ns))
        lines.append(
            f"controller time p99 is {response:.0f} % of the period until the commands are out, {whole:.0f} % with the"
            " estimator's work behind them (goal 30 %)"
        )
    idle, whole_link = _verdict(bare), _verdict(scan)
    lines.append(
        f"the lateness of that loop predicts {1e4 * idle.overruns.get(scan.rate_hz, 0.0):.1f} overruns in 10 000 cycles"
        f" for the whole controller; by the rules of `canprobe check` the loop is {idle.fitness}, the controller"
        f" {whole_link.fitness}"
    )
    for mode in MODES:
        mine = [m for m in measured if m.case == "hold" and m.sensor == mode]
        held = [m.rate_hz for m in mine if not m.ended and m.per_10000 <= HELD_PER_10000]
        best = max((m.held_hz for m in mine), default=0.0)
        lines.append(
            f"{mode}: {f'{max(held):g} Hz held without overruns' if held else 'no rate held without overruns'}"
            f" of {', '.join(f'{m.rate_hz:g}' for m in mine)} Hz; {best:.0f} cycles a second at most"
        )
    lines.append("a real bus of 1 Mbit/s ends at 639 Hz with six drives alone, with any software (worst-case bits)")
    return lines


LINES = ((BLUE, "-"), (ORANGE, "--"), (SKY, ":"))


def draw_realtime(measured: Sequence[Measured], path: Path) -> None:
    """Lateness of SYNC, computing time, answer latency, and held over asked rate."""
    scan, bare = measured[:2]
    rate, seconds = f"{scan.rate_hz:g} Hz", f"{scan.seconds:.0f} s"
    title = (
        f"How well the cycle keeps time: {rate} on a real SocketCAN interface for {seconds}, emulated nodes beside it\n"
        "histograms: all cycles, from a microsecond up; lower right: cycles a second that were reached"
    )
    with picture(path, title, 6.6) as figure:
        panels = parts(figure, 2, 2)
        late = {"canprobe": scan, "a loop that does nothing": bare}
        _histogram(panels[0], "lateness of SYNC (µs)", {name: m.lateness_ns for name, m in late.items()})
        done = {"RPDOs out": scan.response_ns, "work behind them done": scan.compute_ns}
        axes = _histogram(panels[1], "from the last TPDO, whole controller (µs)", done)
        axes.axvline(scan.period_ns * 0.3e-3, color=INK, linewidth=0.9, label="30 % of the period")
        _histogram(panels[2], "SYNC → last TPDO (µs)", {"canprobe": scan.latency_ns})
        _rates(panels[3].subplots(), measured)
        for part in panels:
            legend(part)


def _histogram(part: SubFigure, what: str, series: Mapping[str, Sequence[int]]) -> Axes:
    axes: Axes = part.subplots()
    values = {name: np.maximum(v, 1000) / 1e3 for name, v in series.items() if len(v)}
    if values:
        every = np.concatenate(list(values.values()))
        bins = np.geomspace(max(1.0, float(every.min())), float(every.max()) * 1.01, 60).tolist()
        for (name, v), (colour, line) in zip(values.items(), LINES, strict=False):
            share = np.full(len(v), 100 / len(v))
            axes.hist(v, bins, weights=share, histtype="step", color=colour, linestyle=line, linewidth=1.3, label=name)
        axes.set_ylim(5e-3, 100)
        log_scale(axes, "xy")
    axes.set(xlabel=what, ylabel="share of cycles (%)")
    return axes


def _rates(axes: Axes, measured: Sequence[Measured]) -> None:
    holds = [m for m in measured if m.case == "hold"]
    for mode, (colour, line) in zip(dict.fromkeys(m.sensor for m in holds), LINES, strict=False):
        mine = [m for m in holds if m.sensor == mode]
        axes.plot([m.rate_hz for m in mine], [m.held_hz for m in mine], "o", linestyle=line, color=colour, label=mode)
    top = max((m.rate_hz for m in holds), default=1.0)
    axes.plot([0, top], [0, top], color=GREY, linewidth=0.8, zorder=0, label="as asked")
    axes.axvline(639, color=GREY, linestyle="-.", zorder=0, label="end of 1 Mbit/s, six drives")
    axes.set(xlabel="rate asked, joints held (Hz)", ylabel="cycles a second")
