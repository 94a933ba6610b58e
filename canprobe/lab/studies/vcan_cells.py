"""What studies in real time share: cells on vcan0, their nodes in another process, and the interface itself.

A machine that is busy stands still for tens of milliseconds, which is no fault of the cell: its drives and its master
are `patient`. A virtual bus has no bit rate, so that a plan may have one at which any rate fits (`on_any_bitrate`).
"""

from __future__ import annotations

import atexit
import functools
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.child_process import EmulatorChild
from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.real.opening import open_port
from canprobe.fieldbus.eds.packaged import eds_file
from canprobe.lab.studies.result import measuring_facts

CHANNEL = "vcan0"
"""The interface of studies in real time."""
MISSED_SYNCS, LATE_PERCENT = 250, 100
"""Limits of a patient cell: neither a drop-out nor late cycles end a run at a rate that cannot be held."""
ON_VCAN: Mapping[str, Any] = {"bus.interface": "socketcan", "bus.channel": CHANNEL}
"""Changes that bring a scene to the interface."""
WIRE_BITRATE = 50_000_000
"""Bit rate of the plans at any rate: a virtual bus has none."""


def patience(missed_syncs: int) -> dict[str, Any]:
    """Changes to drives that tolerate missed SYNCs, and to a master that no late cycles stop."""
    return {"arm.missed_syncs": missed_syncs, "limits.late_cycles_max_percent": float(LATE_PERCENT)}


def patient(scene: Scene, missed_syncs: int = MISSED_SYNCS) -> Scene:
    """The scene with `patience`."""
    return load_scene(scene, patience(missed_syncs))


def with_real_nodes(scene: Scene) -> Scene:
    """The scene whose arm and array are served by another process."""
    return load_scene(scene, {"arm.emulated": False, "sensor.emulated": False})


def on_any_bitrate(scene: Scene) -> Scene:
    """The scene with `WIRE_BITRATE`, which no CAN has, and copies of its EDS files that list no bit rates."""
    arm = scene.arm and replace(scene.arm, eds=_eds_for_any_bitrate(scene.arm.eds))
    sensor = scene.sensor and replace(scene.sensor, eds=_eds_for_any_bitrate(scene.sensor.eds))
    return replace(scene, bus=replace(scene.bus, bitrate=WIRE_BITRATE), arm=arm, sensor=sensor)


@functools.cache
def _eds_for_any_bitrate(eds: str) -> str:
    folder = Path(tempfile.mkdtemp(prefix="canprobe-eds-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    copy = folder / eds_file(eds).name
    copy.write_bytes(re.sub(rb"(?m)^(BaudRate_\w+)=1", rb"\1=0", eds_file(eds).read_bytes()))
    return str(copy)


def vcan_facts(quick: bool, runs: int, missed_syncs: int = MISSED_SYNCS) -> dict[str, Any]:
    """Machine, versions and settings of a study on the interface, whose cells are `patient`."""
    limits = {"missed_syncs": missed_syncs, "late_cycles_max_percent": LATE_PERCENT}
    return measuring_facts(quick, runs) | {"interface": CHANNEL, **limits}


def open_vcan() -> Port:
    """A port on the interface."""
    return open_port("socketcan", CHANNEL, 1_000_000, MonotonicClock())


@contextmanager
def served(scene: Scene, *, truth: bool = True) -> Iterator[EmulatorChild]:
    """The nodes of a scene serve within the block, in their own process.

    Args:
        scene: the scene.
        truth: whether they record the true values, which grow with time.
    """
    nodes = EmulatorChild(make_plan(resolve(scene)), None, (CHANNEL,), truth=truth)
    try:
        with closing(open_vcan()) as port:
            nodes.start()
            nodes.await_boot_ups(port)
        yield nodes
    finally:
        nodes.end()


def link(state: str) -> None:
    """Take the interface "down" or "up".

    Raises:
        InterfaceError: the right to do so is missing.
    """
    done = subprocess.run(["ip", "link", "set", CHANNEL, state], capture_output=True, text=True, check=False)
    if done.returncode:
        raise InterfaceError(
            f"{CHANNEL}: the study takes it down and up, and `ip` says: {done.stderr.strip()}; run the study as root"
        )


def replug(after_s: float = 0.0, lasts_s: float = 0.0) -> None:
    """Take the interface down for a time, s, after another one."""
    sleep(after_s)
    link("down")
    sleep(lasts_s)
    link("up")


def sleep(seconds: float) -> None:
    """Sleep for some time, s; not at all for a negative one."""
    clock = MonotonicClock()
    clock.sleep_until_ns(clock.now_ns() + round(max(0.0, seconds) * 1e9))
