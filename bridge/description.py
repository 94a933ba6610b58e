"""The arm of a cell: its frames for viewers with tf, and a URDF whose links are these frames, for RViz and Foxglove.

`link_i` is the frame behind joint i, as `/tf` has it. The solids of an arm from a URDF hang on `axis_i`, the frame that
the joint turns; `/tf_static` has it behind `link_i`. Any other arm is a drum along every axis and bars between them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np
from scipy.spatial.transform import Rotation

from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.geometry import T_flange_probe, transform
from canprobe.cell.scene.hardware import ArmSettings
from canprobe.errors import PlanError
from canprobe.lab.bridge.sample import BASE, FLANGE, PROBE
from canprobe.mechanics.robot import chain as serial
from canprobe.mechanics.robot.chain import Chain
from canprobe.mechanics.robot.urdf_visuals import Visual, find_mesh, visuals_of
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation
from canprobe.mechanics.types import Floats

WHITE, DARK = (236, 233, 224), (76, 84, 94)
DRUM_RADIUS_M = 0.045
"""Radius of the first drum, m; they get thinner towards the flange."""


def link_transforms(chain: Chain, q: Floats) -> list[tuple[str, str, Floats]]:
    """Frame of every link in the frame of the link before.

    Args:
        chain: the arm.
        q: joint positions (n,), rad or m.

    Returns:
        (parent, child, (4, 4) T_parent_child) of the n links, m, base_link first; the last link and the flange are the
        same.
    """
    return [(_link(i), _link(i + 1), T) for i, T in enumerate(serial.link_transforms(chain, q))]


def flange_transform(chain: Chain) -> tuple[str, str, Floats]:
    """The flange lies in the last link's frame."""
    return (_link(chain.n), FLANGE, np.eye(4))


def axis_frame(number: int) -> str:
    """Name of the frame that joint `number`, from 1, turns about its z axis or slides along it."""
    return f"axis_{number}"


def axis_transforms(chain: Chain) -> list[tuple[str, str, Floats]]:
    """Parent, child and T_parent_child (4, 4), m, of each joint's frame behind its link."""
    behind = (*chain.fixed[1:], chain.T_last_flange)
    return [(_link(i), axis_frame(i), np.linalg.inv(T)) for i, T in enumerate(behind, start=1)]


def quaternion_of(R: Floats) -> tuple[float, float, float, float]:
    """Unit quaternion x, y, z, w of a rotation (3, 3), w ≥ 0."""
    x, y, z, w = Rotation.from_matrix(R).as_quat(canonical=True).tolist()
    return x, y, z, w


def urdf_solids(arm: ArmSettings) -> list[Visual]:
    """Solids of an arm's own URDF, each in the frame of its joint, those of the base where the arm is mounted.

    Raises:
        PlanError: the URDF cannot be read.
    """
    if arm.urdf is None:
        return []
    mount = transform(arm.mount_mm, arm.mount_deg)
    solids = visuals_of(Path(arm.urdf), arm.base, arm.tip)
    return [solid if solid.joint else replace(solid, T=mount @ solid.T) for solid in solids]


def simple_solids(chain: Chain) -> list[Visual]:
    """A drum along every axis, fixed to the link before it, and a bar to the next one, thinner towards the flange."""
    solids = []
    for i, (T, behind) in enumerate(zip(chain.fixed, (*chain.fixed[1:], chain.T_last_flange), strict=True)):
        radius, way = DRUM_RADIUS_M * (1.0 - 0.5 * i / chain.n), behind[:3, 3]
        solids.append(Visual(i, T, "cylinder", (radius, 2.0 * radius), "", DARK))
        length = float(np.linalg.norm(way))
        if length > radius:
            bar = homogeneous(tangent_rotation(way / length), 0.5 * way)
            solids.append(Visual(i + 1, bar, "cylinder", (0.7 * radius, length), "", WHITE))
    return solids


def robot_description(plan: Plan) -> str | None:
    """The URDF of a plan's arm, with its probe; None for a cell without an arm.

    Joints have the names of the scene, their ranges and speeds. Meshes are named by absolute `file://` addresses; those
    that are not found are left out.
    """
    arm = plan.setup.arm
    if arm is None:
        return None
    model, chain = arm.model, arm.model.chain
    robot = Xml.Element("robot", name=plan.scene.name)
    base = Xml.SubElement(robot, "link", name=BASE)
    frames = {0: base}
    behind = (*chain.fixed[1:], chain.T_last_flange)
    for i, (joint, T) in enumerate(zip(model.joints, behind, strict=True), start=1):
        frames[i] = Xml.SubElement(robot, "link", name=axis_frame(i))
        kind = "prismatic" if joint.prismatic else "revolute"
        moving = _joint(robot, chain.joints[i - 1], kind, _link(i - 1), axis_frame(i))
        _origin(moving, chain.fixed[0] if i == 1 else np.eye(4))
        Xml.SubElement(moving, "axis", xyz="0 0 1")
        limits = {"lower": joint.q_min, "upper": joint.q_max, "velocity": joint.qd_max}
        limits["effort"] = joint.rated_torque or 0.0
        Xml.SubElement(moving, "limit", {name: f"{value:.12g}" for name, value in limits.items()})
        Xml.SubElement(robot, "link", name=_link(i))
        _origin(_joint(robot, f"{axis_frame(i)}_to_{_link(i)}", "fixed", axis_frame(i), _link(i)), T)
    _fix(robot, FLANGE, _link(chain.n), np.eye(4))
    if (probe := plan.scene.probe) is not None:  # not that of the setup, which is a large sphere with a flat array
        link = _fix(robot, PROBE, FLANGE, T_flange_probe(probe))
        _visual(link, np.eye(4), DARK, "sphere", radius=f"{probe.radius_mm * 1e-3:.12g}")
    assert plan.scene.arm is not None
    shown = list(_own_solids(plan.scene.arm)) or [(solid, _sizes(solid)) for solid in simple_solids(chain)]
    for solid, attributes in shown:
        _visual(frames[solid.joint], solid.T, solid.colour or WHITE, solid.kind, **attributes)
    return Xml.tostring(robot, encoding="unicode")


def _link(i: int) -> str:
    return BASE if i == 0 else f"link_{i}"


def _joint(robot: Xml.Element, name: str, kind: str, parent: str, child: str) -> Xml.Element:
    joint = Xml.SubElement(robot, "joint", name=name, type=kind)
    Xml.SubElement(joint, "parent", link=parent)
    Xml.SubElement(joint, "child", link=child)
    return joint


def _fix(robot: Xml.Element, name: str, parent: str, T: Floats) -> Xml.Element:
    """A link that stands still in another."""
    link = Xml.SubElement(robot, "link", name=name)
    _origin(_joint(robot, f"{name}_fixed", "fixed", parent, name), T)
    return link


def _own_solids(arm: ArmSettings) -> Iterator[tuple[Visual, dict[str, str]]]:
    """Solids of the arm's own URDF that are found, each with its attributes in a URDF."""
    try:
        solids = urdf_solids(arm)
    except PlanError:
        return
    for solid in solids:
        attributes = _sizes(solid)
        if solid.kind == "mesh":
            path = find_mesh(Path(arm.urdf or ""), solid.mesh)
            attributes = {} if path is None else {"filename": path.as_uri(), **attributes}
        if attributes:
            yield solid, attributes


def _sizes(solid: Visual) -> dict[str, str]:
    """Attributes of a solid in a URDF that state its size; none of what a URDF does not know."""
    size = [f"{value:.12g}" for value in solid.size]
    if solid.kind in ("mesh", "box"):
        return {"scale" if solid.kind == "mesh" else "size": " ".join(size)}
    return dict(zip(("radius", "length"), size, strict=False))


def _visual(link: Xml.Element, T: Floats, colour: tuple[int, int, int], kind: str, **attributes: str) -> None:
    visual = Xml.SubElement(link, "visual")
    _origin(visual, T)
    Xml.SubElement(Xml.SubElement(visual, "geometry"), kind, attributes)
    material = Xml.SubElement(visual, "material", name="_".join(f"{part:02x}" for part in colour))
    Xml.SubElement(material, "color", rgba=" ".join(f"{part / 255:.3f}" for part in (*colour, 255)))


def _origin(parent: Xml.Element, T: Floats) -> None:
    """Add translation, and roll, pitch and yaw about fixed axes, as in a URDF."""
    R = T[:3, :3]
    pitch = float(np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0])))
    if abs(np.cos(pitch)) > 1e-9:
        roll, yaw = float(np.arctan2(R[2, 1], R[2, 2])), float(np.arctan2(R[1, 0], R[0, 0]))
    else:  # straight up or down: only their sum counts
        roll, yaw = float(np.arctan2(-R[1, 2], R[1, 1])), 0.0
    xyz, rpy = (" ".join(f"{value + 0.0:.12g}" for value in v) for v in (T[:3, 3], (roll, pitch, yaw)))
    Xml.SubElement(parent, "origin", xyz=xyz, rpy=rpy)
