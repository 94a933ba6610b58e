"""Study `realtime`: how well the cycle keeps time on a real SocketCAN interface, emulated nodes in a child process.

Three measurements: the whole controller at 400 Hz for minutes; a loop that does nothing, for the lateness of the
machine; and the highest rate that is held, for each mode of the sensor, with a controller that only holds the joints.
Needs a `vcan0`; `canprobe vcan --realtime -- canprobe study realtime` runs it where the kernel has none.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import SubFigure

from canprobe.cell.planning.traffic import LAST_LOOK
from canprobe.cell.results.picture import BLUE, GREY, INK, ORANGE, SKY, legend, log_scale, parts, picture
from canprobe.cell.results.summary import percentiles
from canprobe.cell.scene.hardware import TactileModeName
from canprobe.fieldbus.bus.real.socketcan import check_interface
from canprobe.fieldbus.tools.link import AnswerFigures, LinkFigures, LinkLimits, LinkVerdict, judge_link
from canprobe.lab.studies.realtime_cases import (
    CycleTimes,
    Measured,
    Times,
    measure_bare,
    measure_hold,
    measure_scan,
    vcan_facts,
)
from canprobe.lab.studies.result import CHANNEL, Row, Say, StudyResult
from canprobe.lab.studies.sweep import Sweep

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
    check_interface(CHANNEL)
    say = sweep.say
    measured = []
    scan_s, bare_s, hold_s = (4.0, 1.0, 1.0) if quick else (300.0, 100.0, 10.0)
    say(f"the whole controller at 400 Hz, {scan_s:g} s")
    measured.append(measure_scan(scan_s))
    say(f"a loop at 400 Hz that does nothing, {bare_s:g} s")
    measured.append(measure_bare(bare_s))
    for mode in MODES:
        measured += _climb(mode, hold_s, (400,) if quick else RATES_HZ, say)
    facts = vcan_facts(quick, 1) | {"controller": "scan of cylinder; hold elsewhere"}
    draw = partial(draw_realtime, measured)
    return StudyResult("realtime", COLUMNS, [_row(m) for m in measured], findings(measured), facts, draw)


def _climb(mode: TactileModeName, seconds: float, rates_hz: Iterable[float], say: Say) -> list[Measured]:
    """Rising rates, until one loses a tenth of its cycles."""
    climbed = []
    for rate_hz in rates_hz:
        say(f"hold with {mode} at {rate_hz:g} Hz, {seconds:g} s")
        climbed.append(measure_hold(mode, rate_hz, seconds))
        if climbed[-1].ended or climbed[-1].times.rate_hz < 0.9 * rate_hz:
            break
    return climbed


def _row(m: Measured) -> Row:
    times = m.times
    return {
        "case": m.case,
        "sensor": m.sensor,
        "rate_hz": m.rate_hz,
        "held_hz": times.rate_hz,
        "cycles": times.cycles,
        "overruns": times.overruns,
        "overruns_per_10000": per_10000(times),
        "missed_pdos": times.missed,
        **_percentiles("lateness", times.lateness_ns),
        **_percentiles("response", times.response_ns),
        **_percentiles("compute", times.compute_ns),
        **_percentiles("latency", times.latency_ns),
        "processor_percent": None if times.processor_share is None else 100 * times.processor_share,
        "verdict": str(_verdict(m).fitness),
        "ended": m.ended,
    }


def _verdict(m: Measured) -> LinkVerdict:
    """The verdict of `canprobe check` on the cycles of a case: SYNCs that are late, and answers that were missed."""
    times = m.times
    answered, rows = tuple(sorted(times.latency_ns.tolist())), (1,) * times.missed
    answers = AnswerFigures(0, times.cycles, answered, 0, times.missed, rows)
    wait_ns = round(LAST_LOOK * times.period_ns)
    figures = LinkFigures(times.period_ns, sorted(times.lateness_ns.tolist()), wait_ns, (answers,))
    return judge_link(figures, LinkLimits())


def _percentiles(name: str, values_ns: Times) -> dict[str, float | None]:
    return {f"{name}_{what}_us": value for what, value in percentiles(values_ns).items()}


def per_10000(times: CycleTimes) -> float:
    """Overruns in 10 000 cycles."""
    return 1e4 * times.overruns / max(1, times.cycles)


def findings(measured: list[Measured]) -> list[str]:
    """The figures beside the goals."""
    scan, bare = measured[:2]
    lines = [
        f"whole controller at {scan.rate_hz:g} Hz for {scan.times.seconds:.0f} s: {per_10000(scan.times):.1f} overruns"
        f" in 10 000 cycles (goal 1), {scan.times.rate_hz:.1f} cycles a second held",
        f"a loop at {bare.rate_hz:g} Hz that does nothing: {per_10000(bare.times):.1f} overruns in 10 000 cycles, the"
        " machine's own",
    ]
    if len(scan.times.compute_ns):
        of_period = 100.0 / scan.times.period_ns
        response, whole = (of_period * np.percentile(t, 99) for t in (scan.times.response_ns, scan.times.compute_ns))
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
        held = [m.rate_hz for m in mine if not m.ended and per_10000(m.times) <= HELD_PER_10000]
        best = max((m.times.rate_hz for m in mine), default=0.0)
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
    rate, seconds = f"{scan.rate_hz:g} Hz", f"{scan.times.seconds:.0f} s"
    title = (
        f"How well the cycle keeps time: {rate} on a real SocketCAN interface for {seconds}, emulated nodes beside it\n"
        "histograms: all cycles, from a microsecond up; lower right: cycles a second that were reached"
    )
    with picture(path, title, 6.6) as figure:
        panels = parts(figure, 2, 2)
        late = {"canprobe": scan, "a loop that does nothing": bare}
        _histogram(panels[0], "lateness of SYNC (µs)", {name: m.times.lateness_ns for name, m in late.items()})
        done = {"RPDOs out": scan.times.response_ns, "work behind them done": scan.times.compute_ns}
        axes = _histogram(panels[1], "from the last TPDO, whole controller (µs)", done)
        axes.axvline(scan.times.period_ns * 0.3e-3, color=INK, linewidth=0.9, label="30 % of the period")
        _histogram(panels[2], "SYNC → last TPDO (µs)", {"canprobe": scan.times.latency_ns})
        _rates(panels[3].subplots(), measured)
        for part in panels:
            legend(part)


def _histogram(part: SubFigure, what: str, series: dict[str, Times]) -> Axes:
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
        axes.plot(
            [m.rate_hz for m in mine], [m.times.rate_hz for m in mine], "o", linestyle=line, color=colour, label=mode
        )
    top = max((m.rate_hz for m in holds), default=1.0)
    axes.plot([0, top], [0, top], color=GREY, linewidth=0.8, zorder=0, label="as asked")
    axes.axvline(639, color=GREY, linestyle="-.", zorder=0, label="end of 1 Mbit/s, six drives")
    axes.set(xlabel="rate asked, joints held (Hz)", ylabel="cycles a second")
