"""A bus faster than any CAN bus, to measure what limits a cell beyond its bus."""

from __future__ import annotations

import atexit
import functools
import re
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

from canprobe.cell.scene.model import Scene
from canprobe.fieldbus.eds.packaged import eds_file


def on_any_bitrate(scene: Scene, bitrate: int) -> Scene:
    """The scene with a bit rate (bit/s) that no CAN has, and copies of its EDS files that list no bit rates."""
    arm, sensor = scene.arm, scene.sensor
    if arm is not None:
        arm = replace(arm, eds=_eds_for_any_bitrate(arm.eds))
    if sensor is not None:
        sensor = replace(sensor, eds=_eds_for_any_bitrate(sensor.eds))
    return replace(scene, bus=replace(scene.bus, bitrate=bitrate), arm=arm, sensor=sensor)


@functools.cache
def _eds_for_any_bitrate(eds: str) -> str:
    folder = Path(tempfile.mkdtemp(prefix="canprobe-eds-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    copy = folder / eds_file(eds).name
    copy.write_bytes(re.sub(rb"(?m)^(BaudRate_\w+)=1", rb"\1=0", eds_file(eds).read_bytes()))
    return str(copy)
