"""How well the cycle keeps time on a real SocketCAN interface, emulated nodes in a process of their own.

Four questions: the whole controller at 400 Hz for minutes; the same cycle written plainly with canopen-python; a loop
that does nothing at all, for what the machine itself misses; and the highest rate that is held, for each mode of the
sensor, with a controller that only holds the joints.
Needs a `vcan0`; `canprobe vcan --realtime -- canprobe study realtime` runs it where the kernel has none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.bus.socketcan import check_interface
from canprobe.scene import TactileModeName
from canprobe.studies.cycle_times import CycleTimes
from canprobe.studies.realtime_cases import (
    CHANNEL,
    PATIENCE,
    Measured,
    measure_bare,
    measure_hold,
    measure_plain,
    measure_scan,
)
from canprobe.studies.study import Column, Row, StudyResult
from canprobe.studies.study_files import measuring_facts
from canprobe.studies.sweep import Sweep

RATES_HZ = (100, 200, 250, 400, 500, 625, 1000)
MODES: tuple[TactileModeName, ...] = ("features", "window", "image")
HELD_PER_10000 = 1.0
"""Overruns a rate may have to count as held."""
COLUMNS = (
    Column("case", "case"),
    Column("sensor", "sensor"),
    Column("rate_hz", "asked Hz", ".0f"),
    Column("held_hz", "held Hz", ".1f"),
    Column("cycles", "cycles", ".0f"),
    Column("overruns_per_10000", "overruns/10⁴", ".1f"),
    Column("missed_pdos", "missed", ".0f"),
    Column("lateness_p50_us", "late p50 µs", ".0f"),
    Column("lateness_p99_us", "p99", ".0f"),
    Column("lateness_max_us", "max", ".0f"),
    Column("response_p50_us", "response p50 µs", ".0f"),
    Column("response_p99_us", "p99", ".0f"),
    Column("compute_p50_us", "compute p50 µs", ".0f"),
    Column("compute_p99_us", "p99", ".0f"),
    Column("latency_p50_us", "SYNC→last TPDO p50 µs", ".0f"),
    Column("latency_p99_us", "p99", ".0f"),
    Column("processor_percent", "processor %", ".1f"),
    Column("ended", "ended"),
)


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Measure; minutes of real time, or half a minute with `quick`."""
    check_interface(CHANNEL)
    say = sweep.say
    measured = []
    scan_s, bare_s, hold_s = (4.0, 1.0, 1.0) if quick else (300.0, 100.0, 10.0)
    say(f"the whole controller at 400 Hz, {scan_s:g} s")
    measured.append(measure_scan(scan_s))
    say(f"plain canopen-python at 400 Hz, {hold_s:g} s")
    measured.append(measure_plain(hold_s))
    say(f"a loop at 400 Hz that does nothing, {bare_s:g} s")
    measured.append(measure_bare(bare_s))
    for mode in MODES:
        measured += _climb(mode, hold_s, (400,) if quick else RATES_HZ, say)
    facts = measuring_facts(quick, 1) | {
        "interface": CHANNEL,
        "controller": "scan of cylinder; hold elsewhere",
        **PATIENCE,
    }
    return StudyResult("realtime", COLUMNS, [_row(m) for m in measured], findings(measured), facts, _drawer(measured))


def _climb(
    mode: TactileModeName, seconds: float, rates_hz: Iterable[float], say: Callable[[str], None]
) -> list[Measured]:
    """Ever higher rates, until one loses a tenth of its cycles."""
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
        "ended": m.ended,
    }


def _percentiles(name: str, values_ns: Any) -> dict[str, float | None]:
    keys = [f"{name}_{what}_us" for what in ("p50", "p99", "p999", "max")]
    if not len(values_ns):
        return dict.fromkeys(keys)
    return dict(zip(keys, (np.percentile(values_ns, (50, 99, 99.9, 100)) / 1e3).tolist(), strict=True))


def per_10000(times: CycleTimes) -> float:
    """Overruns in 10 000 cycles."""
    return 1e4 * times.overruns / max(1, times.cycles)


def findings(measured: list[Measured]) -> list[str]:
    """What the figures say, against what was hoped for."""
    scan, plain, bare = measured[:3]
    lines = [
        f"whole controller at {scan.rate_hz:g} Hz for {scan.times.seconds:.0f} s: {per_10000(scan.times):.1f} overruns"
        f" in 10 000 cycles (goal 1), {scan.times.rate_hz:.1f} cycles a second held",
        f"plain canopen-python at {plain.rate_hz:g} Hz: {per_10000(plain.times):.0f} overruns in 10 000 cycles,"
        f" {plain.times.rate_hz:.1f} cycles a second held, and it computes nothing",
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
    for mode in MODES:
        mine = [m for m in measured if m.case == "hold" and m.sensor == mode]
        held = [m.rate_hz for m in mine if not m.ended and per_10000(m.times) <= HELD_PER_10000]
        best = max((m.times.rate_hz for m in mine), default=0.0)
        lines.append(
            f"{mode}: {f'{max(held):g} Hz held without overruns' if held else 'no rate held without overruns'}"
            f" of {', '.join(f'{m.rate_hz:g}' for m in mine)} Hz; {best:.0f} cycles a second at most"
        )
    lines.append("a real bus of 1 Mbit/s ends at 639 Hz with six drives alone, whatever the software (worst-case bits)")
    return lines


def _drawer(measured: list[Measured]) -> Callable[[Path], None]:
    def draw(path: Path) -> None:
        from canprobe.studies.realtime_figure import draw_realtime

        draw_realtime(measured, path)

    return draw
