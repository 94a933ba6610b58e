"""Write a cell file for your own arm and a first scene that runs on the emulator at once.

The chain comes from a URDF; without one the file begins with the rows of a PUMA 560, to be replaced. EDS or DCF files
are copied beside the cell file: one for all drives, or one for each joint from the base. The bus has the fastest bit
rate that all of them and the array have. What no file says (counts a turn, gears) has a placeholder with a comment.
"""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canprobe.cli.argument_types import folder_path
from canprobe.cli.parser import Parser
from canprobe.cli.progress import say
from canprobe.errors import PlanError, UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from canprobe.mechanics.robot.model import ArmModel, Joint
    from canprobe.mechanics.robot.urdf import UrdfArm

HELP = "write a cell file and a first scene for your own arm"
EXAMPLE = """\
examples:
  canprobe init my-cell --urdf arm.urdf --tip tool0 --eds drive.eds
  canprobe run my-cell/first.toml
"""
_ARRAY_EDS = "tactile_array"
_RATES_HZ = (400, 1000 / 3, 250, 200, 125, 100, 50)
_SENSOR_HZ = 200
_TRIES = 400
_TILT_TOLD_RAD = math.radians(20)
_GEAR, _COUNTS_PER_TURN, _COUNTS_PER_M = 100, 10_000, 1_000_000


def add_arguments(parser: Parser) -> None:
    """Add the command's arguments."""
    parser.add_argument("folder", metavar="DIR", type=folder_path, help="folder to write into; made if it is missing")
    parser.add_argument("--urdf", metavar="FILE", type=Path, help="URDF of the arm [rows of a PUMA 560]")
    parser.add_argument("--base", metavar="LINK", help="link of the URDF that is the base [its root]")
    parser.add_argument("--tip", metavar="LINK", help="link of the URDF that is the flange [its only end]")
    parser.add_argument(
        "--eds",
        metavar="FILE",
        type=Path,
        action="append",
        default=[],
        help="EDS or DCF of the drives; once, or once a joint",
    )


def run(args: argparse.Namespace) -> int:
    """Write cell.toml and first.toml, with the files that they name."""
    from canprobe.cell.scene.load import written_by_line
    from canprobe.fieldbus.bus.files import write_text, writing
    from canprobe.mechanics.robot.urdf_visuals import with_meshes_found

    folder: Path = args.folder
    for name in ("cell.toml", "first.toml"):
        if (folder / name).exists():
            raise UsageError(f"{folder / name} exists already: choose another folder, or remove it")
    for path in (*args.eds, *([args.urdf] if args.urdf else [])):
        if not path.is_file():
            raise UsageError(f"{path}: no such file")
    if args.urdf is None and (args.base or args.tip):
        raise UsageError("--base and --tip are links of a URDF: give it with --urdf FILE")
    cell = f"{written_by_line()}{_urdf_cell(args) if args.urdf else _dh_cell(args)}"
    with _folder_or_nothing(folder):
        for path in {*args.eds, *([args.urdf] if args.urdf else [])}:
            copy = folder / path.name
            if path.resolve() != copy.resolve():
                with writing(copy):
                    copy.write_bytes(with_meshes_found(path) if path == args.urdf else path.read_bytes())
        first, no_scan = _first_scene(folder, cell)
        write_text(folder / "first.toml", f"{written_by_line()}{first}")
    print(f"wrote {folder / 'cell.toml'} and {folder / 'first.toml'}")
    if no_scan:
        print(f"first.toml moves the arm freely: a scan was refused: {no_scan}")
    print(f"next: canprobe plan {folder / 'first.toml'}")
    print(f"      canprobe run {folder / 'first.toml'}")
    return 0


@contextlib.contextmanager
def _folder_or_nothing(folder: Path) -> Iterator[None]:
    """The folder for the files that the block writes; where the block fails, neither it nor they are left."""
    from canprobe.fieldbus.bus.files import make_folder

    new = [path for path in (folder, *folder.parents) if not path.exists()]
    make_folder(folder)
    before = set(folder.iterdir())
    try:
        yield
    except BaseException:
        for path in set(folder.iterdir()) - before:
            path.unlink()
        for path in new:
            path.rmdir()
        raise


# The cell file.

_HEAD = """\
# A cell: the hardware that scenes run on. All keys: docs/scene-keys.md.
# What is marked "check" is a placeholder that neither the URDF nor the EDS says.

[cell]
name = "{name}"
title = "{name}"

[bus]
bitrate = {bitrate}

"""
_CYCLE = """\
[cycle]
rate_hz = {rate:.12g} # of SYNC and servo; `canprobe plan` says what the drives and the bus can do

"""
_TAIL = """
[sensor]
array = "inch16" # `canprobe cells` lists more; docs/own-array.md describes one of your own
node_id = 16

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


def _urdf_cell(args: argparse.Namespace) -> str:
    from canprobe.mechanics.robot.urdf import from_urdf

    found = from_urdf(args.urdf, args.base, args.tip)
    for warning in found.warnings:
        say(f"canprobe: {warning}")
    text = _HEAD.format(name=_cell_name(args.folder), bitrate=_common_bitrate(args.eds))
    text += "[arm]\n" + f'urdf = "{args.urdf.name}"\n'
    text += "".join(f'{key} = "{link}"\n' for key, link in (("base", args.base), ("tip", args.tip)) if link)
    text += "mount_mm = [0, 0, 0] # where the arm's base stands; the scene's coordinates count from there\n"
    text += _common_eds(args.eds, len(found.joints)) + _TAIL
    postures, tilt = _rounded(found)
    if tilt > _TILT_TOLD_RAD:
        say(
            f"canprobe: the start posture tilts the probe by {math.degrees(tilt):.0f} deg from straight down: of"
            f" {_TRIES} tried postures within the ranges of the joints it is the best of pointing down and being"
            " far from a singularity; the first scene touches a plane as tilted"
        )
    for number, (joint, start) in enumerate(zip(found.joints, postures, strict=True), start=1):
        text += "\n" + _joint_section(number, joint, start, args.eds)
    return text


def _common_bitrate(eds: Sequence[Path]) -> int:
    """The fastest bit rate, bit/s, that all EDS files have; a file that lists none has any.

    Raises:
        UsageError: they have none in common.
    """
    from canprobe.fieldbus.eds.description import Description
    from canprobe.fieldbus.eds.packaged import check_eds

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
        return "emulated = true # false: the drives are real\n"
    name = eds[0].name if eds else "puma260_joint.eds"
    return f'eds = "{name}"\nemulated = true # false: the drives are real\n'


def _joint_section(number: int, joint: Joint, start: float, eds: Sequence[Path]) -> str:
    """One joint; its range and speed stand in the URDF."""
    from canprobe.cell.scene.load import toml_key

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
    """Its stops, rad or m; those of a joint without any room between them are placeholders."""
    if joint.q_min < joint.q_max:
        return joint.q_min, joint.q_max
    return (0.0, 0.1) if joint.prismatic else (-math.pi, math.pi)


def _dh_cell(args: argparse.Namespace) -> str:
    """The packaged PUMA 560 as a template."""
    from canprobe.cell.scene.load import packaged_files

    text = packaged_files("cells")["puma560"].read_text(encoding="utf-8")
    name = _cell_name(args.folder)
    text = text.replace('name = "puma560"', f'name = "{name}"').replace(
        'title = "PUMA 560 with the array and the probe of the PUMA 260"', f'title = "{name}: rows of a PUMA 560"'
    )
    if args.eds:
        text = text.replace("[arm]\n", f"[bus]\nbitrate = {_common_bitrate(args.eds)}\n\n[arm]\n", 1)
        eds = _common_eds(args.eds, 6)
        text = text.replace('eds = "puma260_joint.eds"\n', eds)
        if len(args.eds) == 6:
            for number, path in enumerate(args.eds, start=1):
                text = text.replace(f"node_id = {number}\n", f'node_id = {number}\neds = "{path.name}"\n')
    return "# Replace the rows, ranges, gears and masses by those of your arm.\n#\n" + text


def _cell_name(folder: Path) -> str:
    name = "".join(c if (c.isalnum() and c.isascii()) or c in "_.-" else "-" for c in folder.resolve().name)
    return name if name and name[0].isalnum() else f"cell{name}"


# The first scene: a straight scan over a plane under the probe, where the arm moves well.


def _rounded(found: UrdfArm) -> tuple[list[float], float]:
    """A posture from which the probe points down as far as the arm can, in deg and mm; its tilt from there, rad."""
    import numpy as np

    from canprobe.mechanics.robot.chain import forward_jacobian
    from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset

    tool, rng = tool_z_offset(80.0), np.random.default_rng(0)
    low, high = np.array([_range(joint) for joint in found.joints]).T
    turning = np.array([not joint.prismatic for joint in found.joints])
    low, high = np.where(turning, np.maximum(low, -math.pi), low), np.where(turning, np.minimum(high, math.pi), high)
    best, most, tilt = (low + high) / 2, -math.inf, 0.0
    for _ in range(_TRIES):
        q = low + (high - low) * rng.uniform(0.15, 0.85, len(low))
        T, J = forward_jacobian(found.chain, q, tool)
        singular = np.linalg.svd(J * np.array((5.0, 5.0, 5.0, 1.0, 1.0, 1.0))[:, None], compute_uv=False)
        score = 3.0 * -float(T[2, 2]) + float(singular[min(len(low), 6) - 1]) + 2.0 * min(0.0, float(T[2, 3]))
        if score > most:
            best, most, tilt = q, score, math.acos(min(1.0, max(-1.0, -float(T[2, 2]))))
    shown = [joint.shown(float(value)) for joint, value in zip(found.joints, best, strict=True)]
    return [round(value) for value in shown], tilt


def _first_scene(folder: Path, cell: str) -> tuple[str, str | None]:
    """Write the cell at the fastest rate at which it can do a scan, else free motion; the scene, and why no scan."""
    from canprobe.cell.planning.make import make_plan
    from canprobe.cell.scene.load import parse_scene
    from canprobe.cell.scene.resolve import resolve
    from canprobe.fieldbus.bus.files import write_text

    write_text(folder / "cell.toml", _at_rate(cell, _RATES_HZ[0]))
    refused: dict[float, str] = {}
    problems: list[str] = []
    for scenes in (_scans(folder), (_FREE,)):
        for rate in _RATES_HZ:
            write_text(folder / "cell.toml", _at_rate(cell, rate))
            for text in scenes:
                try:
                    make_plan(resolve(parse_scene(text, file="first.toml", folder=folder)), find_ways=False)
                except PlanError as error:
                    refused.setdefault(rate, error.problems[0])
                    problems = problems or list(error.problems)
                else:
                    return text, refused[rate] if text is _FREE else None
    way = (
        "if the EDS or the URDF that this names is wrong, correct it and type the command again; if it is right, this"
        " cell needs other devices; nothing was written"
    )
    raise PlanError([*problems, way])


def _at_rate(cell: str, rate: float) -> str:
    """The cell file at a rate of the cycle, Hz, with the fastest images up to the array's 200 Hz that divide it."""
    images = rate / math.ceil(rate / _SENSOR_HZ)
    text = cell.replace("[arm]\n", _CYCLE.format(rate=rate) + "[arm]\n", 1)
    if images == _SENSOR_HZ:
        return text
    return text.replace("[sensor]\n", f"[sensor]\nrate_hz = {images:.12g} # images; the cycle is a multiple\n", 1)


_FIRST = 'cell = "cell.toml"\n\n[scene]\nname = "first"\ntitle = "First run on the emulator"\n'

_FREE = _FIRST + '\n[task]\nkind = "free"\nduration_s = 5\n'


def _scans(folder: Path) -> tuple[str, ...]:
    """Scans of the cell in a folder, from demanding to plain: the same at every rate."""
    from canprobe.cell.scene.load import parse_scene
    from canprobe.cell.scene.resolve import resolve

    setup = resolve(parse_scene(_FREE, folder=folder))
    assert setup.arm is not None
    touched = (setup.arm.model, setup.arm.q_start, setup.probe.T_flange_probe)
    return tuple(_FIRST + _touch(*touched, speed, length) for speed, length in ((10, 20), (5, 10)))


def _touch(model: ArmModel, q: NDArray[Any], T_flange_probe: NDArray[Any], speed: float, length: float) -> str:
    """A straight scan over a plane that faces the pole of the probe in the start posture."""
    import numpy as np

    from canprobe.mechanics.robot.chain import forward

    T = forward(model.chain, q) @ T_flange_probe
    pole, place = T[:3, 2], 1e3 * T[:3, 3]
    normal = -pole if model.n > 4 or abs(pole[2]) < 0.99 else np.array((0.0, 0.0, -math.copysign(1.0, pole[2])))
    start = place - 45.0 * normal
    rows = ", ".join(f"{value:.1f}" for value in start)
    roll, pitch = math.degrees(math.asin(-float(normal[1]))), math.degrees(math.atan2(normal[0], normal[2]))
    steep = abs(normal[2]) < 0.9  # then the heading lies in the xy-plane, across the normal
    heading = math.degrees(math.atan2(normal[0], -normal[1])) if steep else 0.0
    rolling = "rolling_share = 1 # the arm holds its orientation\n" if model.n <= 4 else ""
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
