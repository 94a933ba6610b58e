"""Cells drawn by seed from other people's arms, drives and arrays: what `plan` accepts, `run` completes.

An arm is one of the URDFs of example-robot-data or a packaged cell, a drive one of `makes` with what vendors' files
have besides, an array packaged or drawn. Each combination is a folder with files of the user's kind, so that
`canprobe plan FOLDER/scene.toml` repeats it.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from makes import MAKES, Entry, Make, changed, write_eds

import canprobe
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.toml_files import toml_key
from canprobe.errors import CanprobeError, PlanError
from canprobe.fieldbus.eds.packaged import eds_path
from canprobe.mechanics.robot.chain import Chain, forward, forward_jacobian
from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset
from canprobe.mechanics.robot.model import Joint
from canprobe.mechanics.robot.urdf import from_urdf

ARMS = (
    ("ur_description/urdf/ur3_robot.urdf", "base_link", "tool0"),
    ("ur_description/urdf/ur5_robot.urdf", "base_link", "tool0"),
    ("ur_description/urdf/ur10_joint_limited_robot.urdf", "base_link", "tool0"),
    ("panda_description/urdf/panda.urdf", "panda_link0", "panda_hand_tcp"),
    ("kinova_description/robots/kinova.urdf", "base", "j2s6s200_end_effector"),
    ("xarm_description/urdf/xarm7.urdf", "world", "link_eef"),
    ("z1_description/urdf/z1.urdf", "world", "gripperMover"),
    ("so_arm_description/urdf/so101.urdf", "base_link", "gripper_frame_link"),
    ("so_arm_description/urdf/so100.urdf", "base", "jaw"),
    ("talos_data/robots/talos_left_arm.urdf", "arm_left_1_link", "gripper_left_motor_single_link"),
    ("baxter_description/urdf/baxter.urdf", "base", "right_gripper"),
    ("tiago_description/robots/tiago_no_hand.urdf", "base_footprint", "wrist_ft_tool_link"),
    ("pr2_description/urdf/pr2.urdf", "base_footprint", "r_gripper_tool_frame"),
    ("centauro_description/urdf/centauro.urdf", "pelvis", "arm1_8"),
    ("icub_description/robots/icub_reduced.urdf", "chest", "l_hand_dh_frame"),
    ("romeo_description/urdf/romeo.urdf", "base_link", "l_gripper"),
    ("hextilt_description/urdf/hextilt_flying_arm_5.urdf", "hextilt__base_link", "flying_arm_5__gripper"),
    ("allegro_hand_description/urdf/allegro_left_hand.urdf", "palm_link", "link_3.0_tip"),
    ("finger_edu_description/robots/finger_edu.urdf", "base_link", "finger_tip_link"),
    ("solo_description/robots/solo12.urdf", "base_link", "FL_FOOT"),
    ("anymal_b_simple_description/robots/anymal-kinova.urdf", "base", "j2s6s200_end_effector"),
    ("double_pendulum_description/urdf/double_pendulum.urdf", "base_link", "link2"),
)
"""URDF of example-robot-data, base and tip."""
PACKAGED_CELLS = ("puma260", "puma560", "seven-axis", "gantry", "prbt")
PACKAGED_ARRAYS = ("inch16", "uskin4x4", "poweron6x6", "linker12x6", "icub-triangles")
SHARE_PACKAGED = 0.15
POSTURES = 12
"""Postures that are tried for a start: one of them near a stop is a combination, too."""


def robots() -> Path:
    """Folder of the URDFs; the package is a dependency of pin.

    Raises:
        ImportError: pin is not installed.
    """
    import pinocchio

    return Path(pinocchio.__file__).parents[4] / "share/example-robot-data/robots"


# Drives: a make, and what files of vendors have besides.

Objects = dict[tuple[int, int], Entry]
RPM, MILLI_RPM, TURNS_S, DEG_S = 0x00B44700, 0xFDB44700, 0x00B40300, 0x00410300
"""60A9h, unit of a velocity."""


def _speed_in(objects: Objects, rng: Random) -> str:
    """60A9h, and a 607Fh in its unit, which may be writable or not."""
    unit, most = rng.choice(((RPM, 1300), (RPM, 6000), (MILLI_RPM, 3_000_000), (TURNS_S, 50), (DEG_S, 36_000)))
    access = rng.choice(("rw", "ro", "const"))
    high = rng.choice((None, 2 * most))
    objects[0x60A9, 0] = Entry("SI unit velocity", "U32", rng.choice(("rw", "ro")), f"{unit:#010x}")
    objects[0x607F, 0] = Entry("Max profile velocity", "U32", access, most, high=high)
    return f"607Fh {access} {most} in 60A9h {unit:08X}h"


def _speed_fixed(objects: Objects, rng: Random) -> str:
    most = rng.choice((1300, 20_000, 400_000))
    objects[0x607F, 0] = Entry("Max profile velocity", "U32", "ro", most)
    return f"607Fh ro {most}"


def _motor_speed(objects: Objects, rng: Random) -> str:
    most, access = rng.choice((60, 600, 3000)), rng.choice(("rw", "ro"))
    objects[0x6080, 0] = Entry("Max motor speed", "U32", access, most)
    return f"6080h {access} {most}"


def _factors(objects: Objects, rng: Random) -> str:
    for index, (over, under) in zip(
        (0x608F, 0x6091, 0x6092), ((rng.choice((4096, 10_000)), 1), rng.choice(((1, 1), (100, 1), (5, 2))), (4096, 1)),
        strict=True,
    ):  # fmt: skip
        objects[index, 0] = Entry("Highest sub-index supported", "U8", "ro", 2)
        objects[index, 1] = Entry("Numerator", "U32", "rw", over)
        objects[index, 2] = Entry("Denominator", "U32", "rw", under)
    return f"factors, 6091h {objects[0x6091, 1].default}/{objects[0x6091, 2].default}"


def _polarity(objects: Objects, rng: Random) -> str:
    objects[0x607E, 0] = Entry("Polarity", "U8", "rw", rng.choice((0, 0x80, 0xC0)))
    return f"607Eh {objects[0x607E, 0].default}"


def _software_limits(objects: Objects, rng: Random) -> str:
    end, access = rng.choice((20_000, 500_000, 8_388_607)), rng.choice(("rw", "ro"))
    for subindex, value in ((1, -end), (2, end)):
        low, high = (-end, end) if access == "rw" else (None, None)
        objects[0x607D, subindex] = Entry(f"Limit {subindex}", "I32", access, value, low=low, high=high)
    objects[0x607D, 0] = Entry("Highest sub-index supported", "U8", "ro", 2)
    return f"607Dh {access} ±{end}"


def _following(objects: Objects, rng: Random) -> str:
    value, access = rng.choice((10, 200, 2000)), rng.choice(("rw", "ro"))
    objects[0x6065, 0] = Entry("Following error window", "U32", access, value, high=rng.choice((None, value)))
    objects[0x6066, 0] = Entry("Following error time out", "U16", rng.choice(("rw", "ro")), rng.choice((0, 10, 100)))
    return f"6065h {access} {value}, 6066h {objects[0x6066, 0].access} {objects[0x6066, 0].default}"


def _missed_syncs(objects: Objects, rng: Random) -> str:
    index, name = rng.choice(((0x2000, "Missed SYNCs tolerated"), (0x200E, "SYNC time-out factor")))
    objects[index, 0] = Entry(name, "U16", rng.choice(("rw", "ro")), rng.choice((1, 2, 6)))
    return f"{index:04X}h {objects[index, 0].access} {objects[index, 0].default}"


def _without(*indices: int) -> Callable[[Objects, Random], str]:
    def remove(objects: Objects, _: Random) -> str:
        for place in [place for place in objects if place[0] in indices]:
            del objects[place]
        return "without " + " ".join(f"{index:04X}h" for index in indices)

    return remove


def _options(objects: Objects, rng: Random) -> str:
    for index, values in ((0x605A, (1, 2, 5, 6)), (0x6007, (0, 1, 2, 3)), (0x605B, (0, 1)), (0x605C, (0, 1))):
        objects[index, 0] = Entry(f"Option code {index:04X}h", "I16", rng.choice(("rw", "const")), rng.choice(values))
    return "option codes " + " ".join(f"{objects[i, 0].access} {objects[i, 0].default}" for i in (0x605A, 0x6007))


def _inhibit(objects: Objects, rng: Random) -> str:
    time_100us = rng.choice((10, 25, 100))
    for number in range(1, 5):
        with contextlib.suppress(KeyError):
            changed(objects, 0x1800 + number - 1, 3, default=time_100us, access=rng.choice(("rw", "ro")))
    return f"inhibit time {time_100us}"


def _defaults(objects: Objects, rng: Random) -> str:
    """Values as delivered that nobody may rely on."""
    objects[0x607A, 0] = replace(objects[0x607A, 0], default=rng.choice((4000, -70_000)))
    objects[0x6060, 0] = replace(objects[0x6060, 0], default=rng.choice((1, 3, 6)))
    objects[0x6072, 0] = Entry("Max torque", "U16", "rw", rng.choice((0xFFFF, 1000, 300)))
    return f"607Ah {objects[0x607A, 0].default}, 6060h {objects[0x6060, 0].default}"


def _ramps(objects: Objects, rng: Random) -> str:
    for index in (0x6083, 0x6084, 0x6085):
        objects[index, 0] = Entry(f"Ramp {index:04X}h", "U32", rng.choice(("rw", "ro")), rng.choice((0, 100, 10_000)))
    return "ramps " + " ".join(str(objects[index, 0].default) for index in (0x6083, 0x6084, 0x6085))


def _interpolation(objects: Objects, rng: Random) -> str:
    index = rng.choice((-3, -4, -5, -6))
    objects[0x60C2, 1] = Entry("Time", "U8", "rw", 1, low=rng.choice((None, 1)), high=rng.choice((None, 100, 255)))
    objects[0x60C2, 2] = Entry("Index", "I8", rng.choice(("rw", "ro")), index, low=index, high=-3)
    return f"60C2h:02 {objects[0x60C2, 2].access} {index}"


ODDITIES = (
    *(_speed_in, _speed_fixed, _motor_speed, _factors, _polarity, _software_limits, _following, _missed_syncs),
    *(_options, _inhibit, _defaults, _ramps, _interpolation),
    *(_without(0x1006), _without(0x1016, 0x6007), _without(0x6065, 0x6066), _without(0x607D), _without(0x6077)),
)


def draw_drive(rng: Random, folder: Path, number: int) -> tuple[str, str]:
    """File name of a drive's EDS in the folder, and what it is."""
    if rng.random() < SHARE_PACKAGED:
        name = rng.choice(("puma260_joint", "prbt_joint"))
        (folder / f"{name}.eds").write_bytes(eds_path(name).read_bytes())
        return f"{name}.eds", name
    make = MAKES[rng.choice([name for name in MAKES if name != "no_cyclic_mode" or rng.random() < 0.3])]()
    said = [oddity(make.objects, rng) for oddity in rng.sample(ODDITIES, rng.choice((0, 1, 1, 2, 3)))]
    what = ", ".join((make.name, *said))
    bitrates = rng.choice((*(make.bitrates,) * 20, (500, 1000), (125, 250, 500)))
    made: Make = replace(make, name=f"drive{number}", bitrates=bitrates)
    return write_eds(made, folder).name, what


# Arms and arrays.


def draw_arm(rng: Random, folder: Path) -> tuple[str, str, int]:
    """Sections of an arm with its drives, what it is, and the number of its joints."""
    file, base, tip = rng.choice(ARMS)
    path = robots() / file
    (folder / path.name).write_bytes(path.read_bytes())
    found = from_urdf(path, base, tip)
    several = rng.random() < 0.2
    drives = [draw_drive(rng, folder, number) for number in range(1, 1 + (len(found.joints) if several else 1))]
    missed = rng.choice((2, 5, 5, 10))
    text = f'[arm]\nurdf = "{path.name}"\nbase = "{base}"\ntip = "{tip}"\neds = "{drives[0][0]}"\n'
    grouped = rng.choice(("false", "false", '"auto"'))
    text += f"missed_syncs = {missed}\ngrouped_rpdo = {grouped}\n"
    start = draw_posture(rng, found.chain, found.joints)
    for i, joint in enumerate(found.joints):
        text += f"\n[joints.{toml_key(joint.name)}]\n" + "\n".join(_joint_lines(rng, joint, start[i])) + "\n"
        if several:
            text += f'eds = "{drives[i][0]}"\n'
        text += f"node_id = {i + 1}\n"
    what = f"{path.stem} {base}–{tip} ({len(found.joints)}), drives {'; '.join(dict.fromkeys(w for _, w in drives))}"
    return text, what, len(found.joints)


def _joint_lines(rng: Random, joint: Joint, start: float) -> Iterator[str]:
    slides = joint.prismatic
    if slides:
        yield 'kind = "prismatic"'
    yield f"start_{'mm' if slides else 'deg'} = {joint.shown(start):.3f}"
    if not joint.qd_max > 0.0:
        yield f"speed_{'mm_s = 200' if slides else 'deg_s = 90'}"
    if slides:
        yield f"counts_per_m = {rng.choice((100_000, 1_000_000))}"
    else:
        yield f"counts_per_turn = {rng.choice((1000, 4096, 10_000, 65_536))}"
        yield f"gear = {rng.choice((1, 50, 100, 160.5))}"
    yield f"sign = {rng.choice((1, -1))}"
    yield f"zero_counts = {rng.choice((0, 0, 12_345, -70_000))}"


def draw_posture(rng: Random, chain: Chain, joints: tuple[Joint, ...]) -> np.ndarray[Any, Any]:
    """One of a few postures (n,), rad or m: mostly the one that moves best."""
    tool, tried = tool_z_offset(80.0), []
    for _ in range(POSTURES):
        q = np.array([rng.uniform(max(joint.q_min, -math.pi), min(joint.q_max, math.pi)) for joint in joints])
        _, J = forward_jacobian(chain, q, tool)
        tried.append((float(np.linalg.svd(J[: min(6, chain.n)], compute_uv=False)[-1]), tuple(q.tolist())))
    tried.sort(reverse=True)
    return np.array(tried[0 if rng.random() < 0.8 else rng.randrange(POSTURES)][1])


def draw_array(rng: Random, folder: Path, kind: str, rate_hz: float) -> tuple[str, str]:
    """Section of an array, mostly one that suits the kind of task, and what it is."""
    moves = kind in ("scan", "calibrate") and rng.random() < 0.9
    image_hz = f"{min(rate_hz / share for share in (1, 2, 3, 4) if rate_hz / share > 60):.12g}"
    if rng.random() < 0.5:
        name = "inch16" if moves else rng.choice((PACKAGED_ARRAYS[0], *PACKAGED_ARRAYS))
        if name == "inch16":
            return f'[sensor]\narray = "inch16"\nnode_id = 16\nrate_hz = {image_hz}\n', name
        channel = 'channel = "can1"\n' if rng.random() < 0.8 else ""
        return f'[sensor]\narray = "{name}"\nnode_id = 16\n{channel}', name
    sides, pitches = ((10, 12, 16, 16), (1, 1.6, 1.6, 2.5)) if moves else ((1, 4, 8, 12, 16, 24), (1, 1.6, 4, 10, 30))
    rows, columns, pitch = rng.choice(sides), rng.choice(sides), rng.choice(pitches)
    rate = image_hz if rng.random() < 0.8 else rng.choice((50, 100, 200))
    mode = rng.choice(("window", "window", "image", "features"))
    mount = rng.choice(("sphere",) * 3 + ("flat",) * (not moves))
    lines = [f"rows = {rows}", f"columns = {columns}", f"pitch_mm = {pitch}", f'mount = "{mount}"', f'mode = "{mode}"']
    if mode == "window":
        lines.append(f"window = {rng.choice([side for side in (4, 6, 8, 10) if side <= min(rows, columns)] or [4])}")
    lines += [f"rate_hz = {rate}", f"full_scale_kpa = {rng.choice((20, 100, 100, 400))}"]
    (folder / "array.toml").write_text('[array]\ntitle = "drawn"\n\n[sensor]\n' + "\n".join(lines) + "\n")
    return '[sensor]\narray = "array.toml"\nnode_id = 16\n', f"{rows}×{columns} taxels {pitch} mm {mount} {mode}"


# The scene.

KINDS = ("scan",) * 6 + ("press", "calibrate", "free", "listen")


@dataclass(frozen=True)
class Combination:
    """A drawn scene: its file, and what it is."""

    path: Path
    what: str


def draw(seed: int, folder: Path) -> Combination:
    """Draw a combination into a folder.

    Args:
        seed: of the combination.
        folder: for its files; made if it is missing.
    """
    rng = Random(f"combination {seed}")
    folder.mkdir(parents=True, exist_ok=True)
    kind = rng.choice(KINDS)
    rate = rng.choice((333.333, 250, 250, 200, 200, 200, 100, 100)) if rng.random() < 0.95 else 400
    head = f"[cycle]\nrate_hz = {rate}\n\n[bus]\nbitrate = {rng.choice((1_000_000,) * 9 + (500_000,))}\n"
    head += rng.choice(("", "timed = false\n", 'interface = "direct"\n'))
    named = f'[scene]\nname = "drawn"\nseed = {seed}\n\n[outputs]\nfigures = false\n\n'
    radius = rng.choice((10, 20, 40, 40))
    probe = f"\n[probe]\nradius_mm = {radius}\ncentre_offset_mm = {rng.choice((40, 80, 120))}\n"
    array, array_what = draw_array(rng, folder, kind, rate)
    if rng.random() < SHARE_PACKAGED:
        cell = rng.choice(PACKAGED_CELLS)
        text, arm_what = f'cell = "{cell}"\n\n{named}' + (head if cell != "prbt" else ""), cell
        arm = "[arm]\n" if kind != "listen" else ""
    else:
        text, (arm, arm_what, _) = f'{named}[cell]\nname = "drawn"\n\n{head}', draw_arm(rng, folder)
    if kind != "listen":
        text += "\n" + arm
    if kind != "free":
        text += "\n" + array
    text += probe if kind not in ("free", "listen") else ""
    path = folder / "scene.toml"
    task = _task_of(rng, kind, text, folder, radius)
    path.write_text(text + task, encoding="utf-8")
    return Combination(path, f"{kind} at {rate} Hz; {arm_what}; array {array_what}")


def _task_of(rng: Random, kind: str, text: str, folder: Path, radius: float) -> str:
    duration = {"free": 2, "scan": 2}.get(kind, 1)
    if kind in ("free", "listen"):
        return f'\n[task]\nkind = "{kind}"\nduration_s = {duration}\n'
    # the object lies under the probe as it stands in the start posture
    free = text + '\n[task]\nkind = "free"\n'
    (folder / "scene.toml").write_text(free.replace("[sensor]", "[sensor]"), encoding="utf-8")
    posture = re.sub(r"\n\[sensor\]\n(?:[^\[\n].*\n|\n)*", "\n", free)
    (folder / "scene.toml").write_text(posture, encoding="utf-8")
    T = np.diag((1.0, -1.0, -1.0, 1.0))
    with contextlib.suppress(CanprobeError):  # which plan will say of the scene, too
        setup = resolve(canprobe.load_scene(folder / "scene.toml"))
        assert setup.arm is not None
        T = forward(setup.arm.model.chain, setup.arm.q_start) @ setup.probe.T_flange_probe
    tilt = rng.choice((0.0, 0.0, 0.0, 5.0))
    normal = -T[:3, 2]
    start = 1e3 * T[:3, 3] - (radius + rng.choice((2.0, 5.0, 20.0))) * normal
    roll, pitch = math.degrees(math.asin(-float(normal[1]))), math.degrees(math.atan2(normal[0], normal[2]))
    place = ", ".join(f"{value:.2f}" for value in start)
    shape = rng.choice(
        (
            'kind = "plane"',
            'kind = "plane"',
            f'kind = "cylinder"\nradius_mm = {rng.choice((20, 36, 100))}',
            f'kind = "sphere"\nradius_mm = {rng.choice((25, 50, 200))}',
            f'kind = "saddle"\nradius_x_mm = 60\nradius_y_mm = {rng.choice((-80, -30))}',
            f'kind = "bowl"\nradius_mm = {rng.choice((30, 80))}',
            'kind = "wave"\namplitude_mm = 0.5\nwavelength_mm = 40',
        )
    )
    lines = [f'kind = "{kind}"', f"start_mm = [{place}]", f"force_n = {rng.choice((0.5, 1, 2, 2, 3))}"]
    lines += [f"approach_normal = [{', '.join(f'{value:.5f}' for value in normal)}]"]
    if kind == "scan":
        length, speed = rng.choice((4, 10, 20, 40)), rng.choice((5, 10, 25))
        strategy = rng.choice(("weave", "straight", "circle"))
        lines += [f'strategy = "{strategy}"', f"length_mm = {length}", f"speed_mm_s = {speed}"]
        lines += [f"heading_deg = {rng.choice((0, 45, 90))}", f"rolling_share = {rng.choice((0, 0.05, 0.5, 1))}"]
        duration = min(max(2.0 * length / speed, 1.0), 4.0)
    if kind == "calibrate":
        shape = 'kind = "sphere"\nradius_mm = 25'
        lines += [f"touches = {rng.choice((3, 4))}"]
    else:
        lines.append(f"duration_s = {duration:g}")
    rotation = f"rotation_deg = [{roll + tilt:.3f}, {pitch:.3f}, 0]"
    return f"\n[object]\n{shape}\nposition_mm = [{place}]\n{rotation}\n\n[task]\n" + "\n".join(lines) + "\n"


# What becomes of a combination.


@dataclass(frozen=True)
class Outcome:
    """What `plan` and `run` made of a combination.

    Attributes:
        plan: None where it fits, else the first reason.
        run: None where it was done, or not tried, else why it stopped.
    """

    plan: str | None
    run: str | None = None

    @property
    def keeps(self) -> bool:
        """Accepted means done; refused means with a key of the scene, or an object of a file."""
        return self.run is None and (self.plan is None or key_of(self.plan) is not None)


KEY = re.compile(r"(?<![\w./-])(?:task|sensor|array|arm|joints?|cycle|bus|limits|object|probe|wire|shape|plant)[.:]?"
                 r"[\w.-]*|[0-9A-F]{4}h|object [0-9A-F]{4}h")  # fmt: skip


def key_of(problem: str) -> str | None:
    """The key or the object that a refusal names first; None where it names none."""
    found = KEY.search(re.sub(r"\S*/", "", problem))
    return None if found is None else found[0].rstrip(".:")


def outcome_of(path: Path) -> Outcome:
    """Plan a scene, and run it if it fits."""
    try:
        canprobe.plan(path)
    except PlanError as error:
        return Outcome(error.problems[0])
    except CanprobeError as error:
        return Outcome(str(error))
    try:
        result = canprobe.run(path, files=False)
    except CanprobeError as error:
        return Outcome(None, f"{type(error).__name__}: {error}")
    return Outcome(None, None if result.summary["completed"] else str(result.summary["stop_reason"]))
