"""The first scene for `canprobe init`: a straight scan over a plane under the probe, where the arm moves well."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np

from canprobe.cell.planning.make import device_problems, make_plan
from canprobe.cell.scene.load import parse_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.errors import PlanError
from canprobe.fieldbus.bus.files import write_text
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.inverse import FIXED_POLE, task_rows
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.types import Floats

_RATES_HZ = (400, 1000 / 3, 250, 200, 125, 100, 50)
_IMAGE_RATE_HZ = 200
_CYCLE = """\
[cycle]
rate_hz = {rate:.12g} # of SYNC and servo; `canprobe plan` says what the drives and the bus can do

"""
_FIRST = 'cell = "cell.toml"\n\n[scene]\nname = "first"\ntitle = "First run on the emulator"\n'
_FREE = _FIRST + '\n[task]\nkind = "free"\nduration_s = 5\n'


def write_with_first_scene(folder: Path, cell: str) -> tuple[str, str | None]:
    """Write the cell at the fastest rate at which it can do a scan, else free motion; the scene, and why no scan."""
    write_text(folder / "cell.toml", _at_rate(cell, _RATES_HZ[0]))
    refused: dict[float, str] = {}
    problems: list[str] = []
    for scenes in (_scans(folder), (_FREE,)):
        for rate, text in itertools.product(_RATES_HZ, scenes):
            write_text(folder / "cell.toml", _at_rate(cell, rate))
            setup = resolve(parse_scene(text, file="first.toml", folder=folder))
            try:
                make_plan(setup, find_ways=False)
            except PlanError as error:
                refused.setdefault(rate, error.problems[0])
                problems = problems or list(error.problems)
                if device_problems(setup):  # then no rate helps
                    break
            else:
                return text, refused.get(rate, problems[0]) if text is _FREE else None
    way = (
        "if the EDS or the URDF that this names is wrong, correct it and type the command again; if it is right, this"
        " cell needs other devices; nothing was written"
    )
    raise PlanError([*problems, way])


def _at_rate(cell: str, rate: float) -> str:
    """The cell file at a rate of the cycle, Hz, with the fastest images up to the array's 200 Hz that divide it."""
    images = rate / math.ceil(rate / _IMAGE_RATE_HZ)
    text = cell.replace("[arm]\n", _CYCLE.format(rate=rate) + "[arm]\n", 1)
    if images == _IMAGE_RATE_HZ:
        return text
    return text.replace("[sensor]\n", f"[sensor]\nrate_hz = {images:.12g} # images; the cycle is a multiple\n", 1)


def _scans(folder: Path) -> tuple[str, ...]:
    """Scans of the cell in a folder, from demanding to plain: the same at every rate."""
    setup = resolve(parse_scene(_FREE, folder=folder))
    assert setup.arm is not None
    touched = (setup.arm.model, setup.arm.q_start, setup.probe.T_flange_probe)
    return tuple(_FIRST + _touch(*touched, speed, length) for speed, length in ((10, 20), (5, 10)))


def _touch(model: ArmModel, q: Floats, T_flange_probe: Floats, speed: float, length: float) -> str:
    """A straight scan over a plane that faces the pole of the probe in the start posture."""
    T = forward(model.chain, q) @ T_flange_probe
    pole, place = T[:3, 2], 1e3 * T[:3, 3]
    fixed = task_rows(model) == FIXED_POLE
    normal = -pole if not fixed or abs(pole[2]) < 0.99 else np.array((0.0, 0.0, -math.copysign(1.0, pole[2])))
    rows = ", ".join(f"{value:.1f}" for value in place - 45.0 * normal)
    roll, pitch = math.degrees(math.asin(-float(normal[1]))), math.degrees(math.atan2(normal[0], normal[2]))
    steep = abs(normal[2]) < 0.9  # then the heading lies in the xy-plane, across the normal
    heading = math.degrees(math.atan2(normal[0], -normal[1])) if steep else 0.0
    rolling = "rolling_share = 1 # the arm holds its orientation\n" if fixed else ""
    return f"""
[object] # the truth of the emulated contact; delete the section for a real object
kind = "plane"
position_mm = [{rows}]
rotation_deg = [{roll:.3f}, {pitch:.3f}, 0]

[task]
kind = "scan"
strategy = "straight"
force_n = 2
start_mm = [{rows}]
approach_normal = [{normal[0]:.6f}, {normal[1]:.6f}, {normal[2]:.6f}]
heading_deg = {heading:.1f}
length_mm = {length}
speed_mm_s = {speed}
duration_s = 10
{rolling}"""
