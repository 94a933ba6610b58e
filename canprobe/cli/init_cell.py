"""The text of a cell file for `canprobe init`: from a URDF, or from the packaged PUMA 560 as a template."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from canprobe.cell.scene.geometry import transform
from canprobe.cell.scene.load import packaged_files
from canprobe.cell.scene.toml_files import toml_key
from canprobe.cli.output import say
from canprobe.errors import UsageError
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.eds.packaged import check_eds
from canprobe.mechanics.robot.chain import forward_jacobian
from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset
from canprobe.mechanics.robot.model import Joint
from canprobe.mechanics.robot.urdf import UrdfArm, from_urdf
from canprobe.mechanics.types import Floats

_ARRAY_EDS = "tactile_array"
_TRIED_POSTURES = 400
_REPORTED_TILT_RAD = math.radians(20)
_TURNS = (((0, 90, 0), (0, -90, 0)), ((-90, 0, 0), (90, 0, 0)), ((0, 0, 0), (180, 0, 0)))
"""Roll, pitch and yaw, deg, that turn z to x, y, z and to their opposites."""
_MIN_ONWARD_M, _ALONG_COSINE = 1e-3, 0.9
MAX_TRAVEL_M = 100.0
"""Largest stop of a sliding joint in a cell file, m."""
_GEAR, _COUNTS_PER_TURN, _COUNTS_PER_M = 100, 10_000, 1_000_000

_HEAD = """\
# A cell: the hardware that scenes run on. All keys: docs/scene-keys.md.
# A value marked "check" is a placeholder: neither the URDF nor the EDS states it.

[cell]
name = "{name}"
title = "{name}"

[bus]
bitrate = {bitrate}

"""
_TAIL = """
[sensor]
array = "inch16" # `canprobe cells` lists more; docs/own-array.md describes one of your own
node_id = 16
emulated = true # false where the array is real

[probe] # the sphere that carries the array, behind the flange
radius_mm = 40
centre_offset_mm = 80

[limits]
force_max_n = 5
joint_speed_share = 0.5 # of the joints' speeds; raise it once the cell runs

[bring_up]
boot_up_s = 2.0 # raise these where drives are slow
sdo_s = 0.5
"""


def urdf_cell(args: argparse.Namespace) -> str:
    """Write the text of a cell file whose chain comes from a URDF, and warn of values that the URDF leaves open."""
    found = from_urdf(args.urdf, args.base, args.tip)
    for warning in (*found.warnings, *_without_drive(found.joints)):
        say(f"canprobe: {warning}")
    if far := [joint for joint in found.joints if joint.prismatic and max(-joint.q_min, joint.q_max) > MAX_TRAVEL_M]:
        raise UsageError(f"{args.urdf}: {far[0].name}: a joint slides {MAX_TRAVEL_M:g} m at most; correct its <limit>")
    flange_deg = _flange_deg(found)
    turned = transform((0.0, 0.0, 0.0), flange_deg)
    found = replace(found, chain=replace(found.chain, T_last_flange=found.chain.T_last_flange @ turned))
    text = _HEAD.format(name=_cell_name(args.folder), bitrate=_common_bitrate(args.eds))
    text += "[arm]\n" + f'urdf = "{args.urdf.name}"\n'
    text += "".join(f'{key} = "{link}"\n' for key, link in (("base", args.base), ("tip", args.tip)) if link)
    text += "mount_mm = [0, 0, 0] # where the arm's base stands; the scene's coordinates count from there\n"
    text += 'when_disabled = "unknown" # what the arm does without power: "brakes" hold it, or it "sinks"\n'
    text += (
        f"flange_deg = {list(flange_deg)} # turns the frame of the tip: the probe stands along its z"
        f" axis, which is now the tip's {_axis_name(turned)}\n"
    )
    text += _common_eds(args.eds, len(found.joints)) + _TAIL
    start, tilt = _start_posture(found)
    if tilt > _REPORTED_TILT_RAD:
        say(
            f"canprobe: the start posture tilts the probe by {math.degrees(tilt):.0f} deg from straight down; it is the"
            f" best of {_TRIED_POSTURES} tried postures: in none does the probe point down as well, as far from a"
            " singularity; the first scene touches a plane with the same tilt"
        )
    for number, (joint, value) in enumerate(zip(found.joints, start, strict=True), start=1):
        text += "\n" + _joint_section(number, joint, value, args.eds)
    return text


def _without_drive(joints: Sequence[Joint]) -> Iterator[str]:
    """A warning about several joints without a speed where others have one; a single one is often just left open."""
    still = [joint.name for joint in joints if not joint.qd_max > 0.0]
    if 1 < len(still) < len(joints):
        yield (
            f"{', '.join(still)}: no velocity in the <limit>, as of passive joints, which have no drive: an arm with"
            " some (a delta, a parallelogram) is no serial one, and no scan can be planned with it; of a joint with a"
            " drive, correct its speed in the cell file"
        )


def _flange_deg(found: UrdfArm) -> tuple[int, int, int]:
    """Turn of the tip's frame after which z points on from the last joint, as a probe that prolongs the arm stands.

    A tip in the axis of the last joint, or beside it, keeps its z axis.
    """
    onward = found.chain.T_last_flange[:3, :3].T @ found.chain.T_last_flange[:3, 3]
    length = float(np.linalg.norm(onward))
    axis = int(np.argmax(np.abs(onward)))
    if length < _MIN_ONWARD_M or abs(onward[axis]) < _ALONG_COSINE * length:
        return 0, 0, 0
    return _TURNS[axis][0 if onward[axis] > 0.0 else 1]


def _axis_name(turned: Floats) -> str:
    axis = int(np.argmax(np.abs(turned[:3, 2])))
    return f"{'-' if turned[axis, 2] < 0.0 else ''}{'xyz'[axis]}"


def _common_bitrate(eds: Sequence[Path]) -> int:
    """The fastest bit rate, bit/s, that all EDS files have; a file that lists none has any.

    Raises:
        UsageError: when they have no common one.
    """
    rates = {str(path): set(Description(check_eds(path).dictionary).bitrates) for path in dict.fromkeys(eds)}
    rates[_ARRAY_EDS] = set(Description(check_eds(_ARRAY_EDS).dictionary).bitrates)
    listed = {name: has for name, has in rates.items() if has}
    if common := set.intersection(*listed.values()):
        return max(common)
    lists = "; ".join(f"{name} has {', '.join(map(str, sorted(has)))} bit/s" for name, has in listed.items())
    raise UsageError(f"--eds: no bit rate is common to all devices of the bus: {lists}; the cell needs other devices")


def _common_eds(eds: Sequence[Path], joints: int) -> str:
    if len(eds) not in (0, 1, joints):
        raise UsageError(f"--eds: expected one file, or one for each of the {joints} joints, got {len(eds)}")
    if len(eds) == joints and joints > 1:
        return "emulated = true # false where the drives are real\n"
    name = eds[0].name if eds else "puma260_joint.eds"
    return f'eds = "{name}"\nemulated = true # false where the drives are real\n'


def _joint_section(number: int, joint: Joint, start: float, eds: Sequence[Path]) -> str:
    """The section of one joint; its range and speed are in the URDF."""
    lines = [f"[joints.{toml_key(joint.name)}]"]
    if joint.prismatic:
        lines += ['kind = "prismatic"', f"start_mm = {start:g}"]
    else:
        lines += [f"start_deg = {start:g}"]
    if joint.q_min == joint.q_max:
        low, high = (round(joint.shown(q)) for q in _range(joint))
        lines += [f"min_{joint.unit} = {low} # check", f"max_{joint.unit} = {high} # check"]
    if not joint.qd_max > 0.0:
        lines += ["speed_mm_s = 100 # check" if joint.prismatic else "speed_deg_s = 30 # check"]
    lines += [f"node_id = {number} # check"]
    if len(eds) > 1:
        lines += [f'eds = "{eds[number - 1].name}"']
    if joint.prismatic:
        lines += [f"counts_per_m = {_COUNTS_PER_M} # check"]
    else:
        lines += [f"counts_per_turn = {_COUNTS_PER_TURN} # check: position units of the drive per motor turn"]
        lines += [f"gear = {_GEAR} # check: motor turns per turn of the joint"]
    lines += ["sign = 1 # check: -1 where the drive counts the other way", "zero_counts = 0 # check"]
    return "\n".join(lines) + "\n"


def _range(joint: Joint) -> tuple[float, float]:
    """Stops of a joint, rad or m; placeholders where they are equal."""
    if joint.q_min < joint.q_max:
        return joint.q_min, joint.q_max
    return (0.0, 0.1) if joint.prismatic else (-math.pi, math.pi)


def template_cell(args: argparse.Namespace) -> str:
    """Write the text of a cell file without a URDF: the packaged PUMA 560 as a template."""
    text = packaged_files("cells")["puma560"].read_text(encoding="utf-8")
    name = _cell_name(args.folder)
    text = text.replace('name = "puma560"', f'name = "{name}"').replace(
        'title = "PUMA 560 with the array and the probe of the PUMA 260"', f'title = "{name}: rows of a PUMA 560"'
    )
    if args.eds:
        text = text.replace("[arm]\n", f"[bus]\nbitrate = {_common_bitrate(args.eds)}\n\n[arm]\n", 1)
        text = text.replace('eds = "puma260_joint.eds"\n', _common_eds(args.eds, 6))
        if len(args.eds) == 6:
            for number, path in enumerate(args.eds, start=1):
                text = text.replace(f"node_id = {number}\n", f'node_id = {number}\neds = "{path.name}"\n')
    return "# Replace the rows, ranges, gears and masses by those of your arm.\n#\n" + text


def _cell_name(folder: Path) -> str:
    name = "".join(c if (c.isalnum() and c.isascii()) or c in "_.-" else "-" for c in folder.resolve().name)
    return name if name and name[0].isalnum() else f"cell{name}"


def _start_posture(found: UrdfArm) -> tuple[list[float], float]:
    """A posture from which the probe points down as far as the arm can, in deg and mm; its tilt from there, rad."""
    tool, rng = tool_z_offset(80.0), np.random.default_rng(0)
    low, high = np.array([_range(joint) for joint in found.joints]).T
    turning = np.array([not joint.prismatic for joint in found.joints])
    low, high = np.where(turning, np.maximum(low, -math.pi), low), np.where(turning, np.minimum(high, math.pi), high)
    best, most, tilt = (low + high) / 2, -math.inf, 0.0
    for _ in range(_TRIED_POSTURES):
        q = low + (high - low) * rng.uniform(0.15, 0.85, len(low))
        T, J = forward_jacobian(found.chain, q, tool)
        singular = np.linalg.svd(J * np.array((5.0, 5.0, 5.0, 1.0, 1.0, 1.0))[:, None], compute_uv=False)
        score = 3.0 * -float(T[2, 2]) + float(singular[min(len(low), 6) - 1]) + 2.0 * min(0.0, float(T[2, 3]))
        if score > most:
            best, most, tilt = q, score, math.acos(min(1.0, max(-1.0, -float(T[2, 2]))))
    shown = [joint.shown(float(value)) for joint, value in zip(found.joints, best, strict=True)]
    return [round(value) for value in shown], tilt
