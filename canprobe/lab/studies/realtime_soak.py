"""Study `realtime --soak`: memory, clocks and counters of a cell over half an hour on a real SocketCAN interface.

The cell is held as `canprobe up` holds it, emulated nodes in a child process, all PDOs on the bus, and
`canprobe monitor` watches. For a nightly run: `canprobe vcan --realtime -- canprobe study realtime --soak`.
"""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.options import RunOptions
from canprobe.cell.results.picture import BLUE, GREEN, ORANGE, legend, parts, picture
from canprobe.cell.scene.load import load_scene
from canprobe.cell.session.session import Session
from canprobe.cell.session.up import ROWS_OF_UP
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.real.socketcan import check_interface
from canprobe.lab.studies.result import Row, StudyResult
from canprobe.lab.studies.sweep import Sweep
from canprobe.lab.studies.vcan_cells import CHANNEL, ON_VCAN, patient, served, vcan_facts, with_real_nodes

SOAK_S = 1800.0
SAMPLES = 60
SETTLED = 0.25
"""Share of the run after which memory should be constant."""


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Hold the cell for half an hour, or for ten seconds with `quick`."""
    check_interface(CHANNEL)
    seconds = 10.0 if quick else SOAK_S
    sweep.say(f"hold the cell for {seconds:g} s")
    rows, ended = soak(seconds)
    facts = vcan_facts(quick, 1) | {"seconds": seconds}
    return StudyResult("soak", rows, findings(rows, ended), facts, partial(draw_soak, rows))


def soak(seconds: float) -> tuple[list[Row], str]:
    """Hold the cell, and take a sample every sixtieth of the time.

    Returns:
        The samples, and why the cell stopped before the time; empty where it did not.
    """
    scene = load_scene("cylinder", {**ON_VCAN, "cycle.realtime": True})
    samples: list[Row] = []
    with watched() as monitor_pid, served(scene, truth=False) as nodes:
        session = Session(with_real_nodes(patient(scene)), RunOptions(rows_kept=ROWS_OF_UP))
        pids = {"master_mib": os.getpid(), "nodes_mib": nodes.process.pid, "monitor_mib": monitor_pid}

        def hold(measurement: Measurement) -> Command:
            t_s = measurement.t_ns * 1e-9
            if t_s >= len(samples) * seconds / SAMPLES:
                samples.append(sample(session, t_s, pids))
            return Command(done=t_s >= seconds)

        ended = ""
        try:
            with session:
                session.run(hold)
        except CanprobeError as error:
            if not samples:
                raise
            ended = str(error)
    counted = {key: samples[0][key] for key in ("frames_counted", "frames_on_bus")}
    return [s | {key: s[key] - first for key, first in counted.items()} for s in samples], ended


def sample(session: Session, t_s: float, pids: Mapping[str, int]) -> Row:
    """Memory of some processes, counters of the cell and of the interface."""
    cell = session.cell
    cycle, drives, counters = cell.cycle, cell.drives, cell.port.counters
    assert cycle is not None and drives is not None
    return {
        "t_s": t_s,
        **{name: resident_mib(pid) for name, pid in pids.items()},
        "cycles": cycle.number,
        "overruns": cycle.statistics.overruns,
        "missed_pdos": drives.missed,
        "dropped_frames": counters.overruns,
        "latency_us": drives.answer_ns * 1e-3,
        "frames_counted": counters.sent + counters.received,
        "frames_on_bus": packets_on(CHANNEL),
    }


@contextmanager
def watched() -> Iterator[int]:
    """`canprobe monitor` with a terminal of its own, which gets what the others leave; its process id."""
    shown, terminal = pty.openpty()
    words = ["monitor", "cylinder", "--bus", "socketcan", "--channel", CHANNEL]
    command = ["nice", "-n", "19", sys.executable, "-m", "canprobe", *words]
    monitor = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=terminal, start_new_session=True)
    os.close(terminal)
    readers = []
    try:
        os.read(shown, 1)  # the first screen
        readers.append(subprocess.Popen(["cat"], stdin=shown, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
        yield monitor.pid
    finally:
        monitor.kill()  # it sends nothing, so there is nothing to end
        monitor.wait()
        for reader in readers:  # it ends with the terminal
            reader.wait()
        os.close(shown)


def resident_mib(pid: int) -> float:
    """Resident memory of a process, MiB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def packets_on(channel: str) -> int:
    """Frames that the kernel has counted on an interface."""
    return int(Path(f"/sys/class/net/{channel}/statistics/tx_packets").read_text(encoding="ascii"))


def findings(samples: Sequence[Row], ended: str = "") -> list[str]:
    """Growth of memory, change of latency, frames and cycles; before them why the cell stopped early, if it did."""
    first, last = samples[0], samples[-1]
    settled = [s for s in samples if s["t_s"] >= SETTLED * last["t_s"]]
    tenth = max(1, len(samples) // 10)
    begin, end = (float(np.median([s["latency_us"] for s in part])) for part in (samples[:tenth], samples[-tenth:]))
    counted, seen = last["frames_counted"], last["frames_on_bus"]
    since = {name: last[name] - first[name] for name in ("dropped_frames", "cycles", "overruns", "missed_pdos")}
    early = [f"the cell stopped after {last['t_s']:.0f} s: {ended}"] if ended else []
    return [
        *early,
        f"memory of the master grew by {_growth(settled, 'master_mib'):+.2f} MiB/h, of the nodes by"
        f" {_growth(settled, 'nodes_mib'):+.2f} MiB/h, of a monitor by {_growth(settled, 'monitor_mib'):+.2f} MiB/h,"
        " after the first quarter",
        f"SYNC → last TPDO by the kernel's stamps: {begin:.0f} µs in the first tenth, {end:.0f} µs in the last",
        f"{counted} frames counted by the master, {seen} by the interface in the same time:"
        f" {seen - counted:+d} under way or lost, {since['dropped_frames']} dropped by the kernel",
        f"{since['cycles']} cycles, {since['overruns']} overruns, {since['missed_pdos']} PDOs missed",
    ]


def _growth(samples: Sequence[Row], name: str) -> float:
    """Slope of a column, MiB/h."""
    if len(samples) < 2:
        return 0.0
    t_h = np.array([s["t_s"] for s in samples]) / 3600
    slope = np.polyfit(t_h, [s[name] for s in samples], 1)[0]
    return round(float(slope), 2) + 0.0  # no minus zero


def draw_soak(samples: Sequence[Row], path: Path) -> None:
    """Memory, answer latency and overruns over time."""
    title = f"The cell held for {samples[-1]['t_s']:.0f} s on vcan0: memory, answer time, losses"
    with picture(path, title, 6.6) as figure:
        panels = parts(figure, 3, 1)
        memory, latency, lost = (part.subplots() for part in panels)
        minutes = [s["t_s"] / 60 for s in samples]
        memory.plot(minutes, [s["master_mib"] for s in samples], color=BLUE, label="master")
        memory.plot(minutes, [s["nodes_mib"] for s in samples], "--", color=ORANGE, label="emulated nodes")
        memory.plot(minutes, [s["monitor_mib"] for s in samples], ":", color=GREEN, label="monitor")
        latency.plot(minutes, [s["latency_us"] for s in samples], ".-", color=BLUE)
        lost.plot(minutes, [s["overruns"] for s in samples], color=BLUE, label="overruns")
        lost.plot(minutes, [s["missed_pdos"] for s in samples], "--", color=ORANGE, label="PDOs missed")
        labels = ("resident\nmemory (MiB)", "SYNC →\nlast TPDO (µs)", "number so far")
        for axes, part, label in zip((memory, latency, lost), panels, labels, strict=True):
            axes.set_ylim(bottom=-0.04 * axes.get_ylim()[1])
            axes.set(xlabel="time (min)", ylabel=label)
            legend(part)
