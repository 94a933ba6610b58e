"""Makes the arm of the sections `[arm]` and `[joints.*]`: chain, joints, drive units, bodies, drives.

The chain is read from a URDF or from Denavit-Hartenberg rows. What a joint's section gives replaces what the URDF says.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from canprobe.cell.scene.geometry import transform
from canprobe.cell.scene.hardware import MM, ArmSettings, JointSettings
from canprobe.cell.scene.setup import Arm, External, HomingParameters
from canprobe.cell.scene.units import in_si
from canprobe.errors import PlanError
from canprobe.mechanics.robot.denavit_hartenberg import dh_step, from_dh
from canprobe.mechanics.robot.model import ArmModel, Body, Joint, lopsided_inertia, negative_inertia
from canprobe.mechanics.robot.urdf import UrdfArm, from_urdf, limit_warning
from canprobe.mechanics.types import Floats

Bodies = tuple[Body | None, ...] | None
MIN_SPEED_RAD_S, MIN_SPEED_M_S = math.radians(0.01), 1e-5
"""Speed limits below which a joint of a URDF practically stands: a degree takes it longer than a minute and a half."""

_FIELDS = {
    "min": "q_min",
    "max": "q_max",
    "speed": "qd_max",
    "acceleration": "qdd_max",
    "rated_torque": "rated_torque",
    "rated_force": "rated_torque",
    "rotor_inertia": "rotor_inertia",
    "rotor_mass": "rotor_inertia",
    "coulomb": "coulomb",
    "viscous": "viscous",
}
"""Field of a `Joint` by the key of a section without its unit."""
EXTERNAL_SWING = np.array((10e-3,) * 3 + (math.radians(5.0),) * 3)
"""Amplitude of an external arm in `free`, m and rad: that of joints by default."""
_PRISMATIC_DEFAULTS = {"rated_torque": 200.0, "rotor_inertia": 5.0, "coulomb": 20.0, "viscous": 20.0}


def arm_model(
    name: str, arm: ArmSettings, sections: Mapping[str, JointSettings]
) -> tuple[ArmModel, Bodies, tuple[str, ...]]:
    """The arm of a cell, the bodies of its links (None where masses are not known), and warnings about its URDF.

    Args:
        name: name of the cell.
        arm: the section `[arm]`.
        sections: the sections of the joints, from the base.

    Raises:
        PlanError: the URDF cannot be used, or joints and sections contradict each other.
    """
    mount, flange = transform(arm.mount_mm, arm.mount_deg), transform(arm.flange_mm, arm.flange_deg)
    if arm.urdf is not None:
        found = from_urdf(arm.urdf, arm.base, arm.tip, name=name)
        _refuse_other_names(found, sections, arm)
        fixed = found.chain.fixed.copy()
        fixed[0] = mount @ fixed[0]
        chain = replace(found.chain, fixed=fixed, T_last_flange=found.chain.T_last_flange @ flange)
        joints = [_joint(section, joint) for section, joint in zip(sections.values(), found.joints, strict=True)]
        _refuse_standstill(arm.urdf, found.joints, sections)
        bodies: Bodies = found.bodies if any(found.bodies) else None
        settled = {
            limit_warning(arm.urdf, joint)
            for joint, section in zip(found.joints, sections.values(), strict=True)
            if {"min", "max"} & set(in_si(section))
        }
        warnings = tuple(warning for warning in found.warnings if warning not in settled)
    else:
        rows = [tuple(s[name] for name in ("a", "alpha", "d", "theta")) for s in map(in_si, sections.values())]
        slides = [section.kind == "prismatic" for section in sections.values()]
        chain = from_dh(
            rows,
            arm.convention,
            name=name,
            joints=list(sections),
            prismatic=slides,
            T_base_mount=mount,
            T_last_flange=flange,
        )
        joints = [_joint(section, _bare(joint, section)) for joint, section in sections.items()]
        known = all(section.mass_kg is not None for section in sections.values())
        each = zip(sections.values(), rows, strict=True)
        _refuse_impossible_inertia(sections)
        bodies = tuple(_body(section, row, arm) for section, row in each) if known else None
        warnings = ()
    model = ArmModel(chain, tuple(joints), _units_per_q(sections), np.array([s.zero_counts for s in sections.values()]))
    return model, bodies, warnings


def external_arm(name: str, arm: ArmSettings, rate_hz: float) -> Arm:
    """An arm that is not on the bus: its joints are the coordinates of its flange.

    Args:
        name: name of the cell.
        arm: the section `[arm]`.
        rate_hz: rate of the cycle.
    """
    from canprobe.mechanics.robot.flange import flange_model

    mount, home = transform(arm.mount_mm, arm.mount_deg), transform((0.0, 0.0, 0.0), arm.flange_deg)
    reach, speed = (
        np.array((*(length * MM,) * 3, *(math.radians(angle),) * 3))
        for length, angle in ((arm.reach_mm, arm.reach_deg), (arm.speed_mm_s, arm.speed_deg_s))
    )
    start = np.array(arm.start_mm) * MM
    external = External(arm.address, arm.emulated, arm.delay_ms * 1e-3, arm.stop_after_ms * 1e-3)
    model = flange_model(name, mount, home[:3, :3], start, reach, speed)
    q_start, missed = np.concatenate((start, np.zeros(3))), max(1, int(external.stop_after_s * rate_hz))
    return Arm(model, (), q_start, missed, grouped=False, torque=False, external=external)


def _refuse_other_names(found: UrdfArm, sections: Mapping[str, JointSettings], arm: ArmSettings) -> None:
    names = found.chain.joints
    if tuple(sections) != names:
        listed = ", ".join(sections) or "none"
        raise PlanError(
            [f"joints: expected the joints of {arm.urdf} in their order ({', '.join(names)}), got {listed}"]
        )
    for joint, section in zip(found.joints, sections.values(), strict=True):
        kind = "prismatic" if joint.prismatic else "revolute"
        if section.kind != kind:
            raise PlanError([f'joints.{joint.name}.kind: expected "{kind}" as in {arm.urdf}, got "{section.kind}"'])


def _refuse_standstill(urdf: str, joints: Sequence[Joint], sections: Mapping[str, JointSettings]) -> None:
    """Refuse a missing or tiny speed limit of the file where the section has none: it was hardly meant."""
    problems = [
        f"{urdf}: joint {joint.name}: expected a velocity in its <limit> of at least {slowest:.3g} {unit}/s, got"
        f" {joint.qd_max:g}; put it right there, or set joints.{joint.name}.speed_{joint.unit}_s; a passive joint, as"
        " of a delta, has no drive, and its arm is no serial one"
        for joint, section in zip(joints, sections.values(), strict=True)
        for slowest, unit in [(MIN_SPEED_M_S, "m") if joint.prismatic else (MIN_SPEED_RAD_S, "rad")]
        if "speed" not in in_si(section) and not joint.qd_max >= slowest
    ]
    problems += [
        f"{urdf}: joint {joint.name}: expected lower below upper in its <limit>, got {joint.q_min:g} and "
        f"{joint.q_max:g}; put it right there, or set joints.{joint.name}.min_{joint.unit} and max_{joint.unit}"
        for joint, section in zip(joints, sections.values(), strict=True)
        if not joint.q_min < joint.q_max and not {"min", "max"} <= set(in_si(section))
    ]
    if problems:
        raise PlanError(problems)


def _bare(name: str, section: JointSettings) -> Joint:
    prismatic = section.kind == "prismatic"
    return Joint(name, prismatic, 0.0, 0.0, 0.0, **(_PRISMATIC_DEFAULTS if prismatic else {}))


def _joint(section: JointSettings, joint: Joint) -> Joint:
    return replace(joint, **{_FIELDS[name]: value for name, value in in_si(section).items() if name in _FIELDS})


def _units_per_q(sections: Mapping[str, JointSettings]) -> Floats:
    """(n, n) drive units per rad or m of each joint."""
    names = list(sections)
    turns = np.diag([section.gear for section in sections.values()])
    for i, section in enumerate(sections.values()):
        for other, share in (section.coupling or {}).items():
            turns[i, names.index(other)] = share
    units = [s.sign * (s.counts_per_turn or s.counts_per_m or 0.0) for s in sections.values()]
    radians = [1.0 if section.kind == "prismatic" else 2 * math.pi for section in sections.values()]
    scaled: Floats = np.diag(units) @ turns / np.array(radians)
    return scaled


def _tensor(section: JointSettings) -> Floats:
    xx, yy, zz, xy, xz, yz = section.inertia_kg_m2
    return np.array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))


def _refuse_impossible_inertia(sections: Mapping[str, JointSettings]) -> None:
    """Moments of 0 beside others are not known, as of a link that only turns about one axis: they are not compared."""
    given = {name: section for name, section in sections.items() if min(section.inertia_kg_m2[:3]) != 0.0}
    tensors = {name: _tensor(section) for name, section in given.items()}
    found = {name: negative_inertia(tensor) or lopsided_inertia(tensor) for name, tensor in tensors.items()}
    problems = [
        f"joints.{name}.inertia_kg_m2: expected xx, yy, zz, xy, xz, yz that a body can have, got {why}"
        for name, why in found.items()
        if why is not None
    ]
    if problems:
        raise PlanError(problems)


def _body(section: JointSettings, row: tuple[float, float, float, float], arm: ArmSettings) -> Body:
    """The link behind a joint, in the frame of the joint; a row gives it in the frame that the row leads to."""
    T = np.eye(4) if arm.convention == "modified" else dh_step(*row)
    return Body(section.mass_kg or 0.0, np.array(section.com_mm) * MM, _tensor(section)).moved(T)


def per_joint(sections: Mapping[str, JointSettings], key: Literal["start", "swing"]) -> Floats:
    """(n,) rad or m of a key that is in degrees or in millimetres, as the joint turns or slides."""
    return np.array([in_si(section)[key] for section in sections.values()])


def posture_in_si(sections: Mapping[str, JointSettings], posture: Sequence[float]) -> Floats:
    """(n,) rad or m of a posture in degrees or millimetres."""
    scale = [MM if section.kind == "prismatic" else math.radians(1.0) for section in sections.values()]
    return np.array(posture) * scale


def homing_of(section: JointSettings, number: int) -> HomingParameters | None:
    """Parameters of homing of a joint, by its number from 1; None where its encoder is absolute."""
    if section.zero == "absolute":
        return None
    its = in_si(section)
    return HomingParameters(
        its["homing_method"],
        section.homing_order or number,
        home=its.get("home", 0.0),
        speed=its["homing_speed"],
        zero_speed=its["homing_zero_speed"],
        acceleration=its["homing_acceleration"],
        timeout_s=section.homing_timeout_s,
    )
