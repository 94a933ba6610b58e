"""A serial arm from a URDF: its chain from a base link to a tip link, limits of its joints, and bodies.

Fixed joints are merged into the transforms beside them. A joint's frame is turned until its axis is z, as `Chain`
expects. Branches off the path (a gripper, a cover) stand still at their zeros and count as bodies of the link that
carries them. Visuals are read separately (`urdf_visuals`), as only a view needs them.

Source: URDF specification (wiki.ros.org/urdf/XML, joint, link, inertial).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from canprobe.errors import PlanError
from canprobe.mechanics.robot.chain import MAX_JOINTS, Chain
from canprobe.mechanics.robot.model import Body, Joint, lopsided_inertia
from canprobe.mechanics.robot.urdf_tree import UrdfTree, source_name, z_along

MAX_STOP_RAD, MAX_STOP_M = 4 * math.pi, 5.0
"""Largest stop of a joint that does not look like one in degrees, rad, or in millimetres, m."""
MAX_REACH_M = 20.0
"""Largest sum of the distances between joints that does not look like one in millimetres, m."""


@dataclass(frozen=True, slots=True, eq=False)
class UrdfArm:
    """An arm as a URDF describes it.

    Attributes:
        chain: chain from base to tip.
        joints: stops, speeds and friction of its joints; the effort limit is taken as the rated torque. Values that the
            file leaves out are the defaults of `Joint`, but a missing speed limit is 0, which an `ArmModel` refuses.
        bodies: (n,) bodies of the joints; None for a joint without any inertial.
        warnings: messages about values of the file that look like mistakes.
    """

    chain: Chain
    joints: tuple[Joint, ...]
    bodies: tuple[Body | None, ...]
    warnings: tuple[str, ...] = ()


def from_urdf(
    source: str | Path, base: str | None = None, tip: str | None = None, *, name: str | None = None
) -> UrdfArm:
    """Read a serial arm from a URDF.

    Args:
        source: path of the file, or its text.
        base: link that is the base frame; the root by default.
        tip: link whose frame is the flange; by default the only link without children that drives can move.
        name: name of the arm; by default that of the robot.

    Raises:
        PlanError: the file is no URDF, there is no path from base to tip, a joint on the path cannot be moved by a
            drive, or `Chain` refuses the result.
    """
    tree = UrdfTree.read(source)
    base = base or tree.root()
    path = tree.path(base, tip or tree.only_end(base))
    moving = [edge for edge in path if edge.kind != "fixed"]
    if len(moving) > MAX_JOINTS:
        raise PlanError(
            [
                f"{tree.where}: {len(moving)} joints move between {path[0].parent!r} and {path[-1].child!r}, at most"
                f" {MAX_JOINTS} can; choose a base nearer to the tip, such as --base {moving[-MAX_JOINTS].parent}"
                " (arm.base)"
            ]
        )
    places, joints, bodies = [], [], []
    T = np.eye(4)  # from the last joint's frame, its axis along z, to where the path has come
    turned = np.eye(4)  # rotation of that frame within the frame that the file gives the joint
    for edge in path:
        T = T @ edge.T_parent_child
        if edge.kind == "fixed":
            continue
        joints.append(tree.joint(edge))
        turned = z_along(tree.axis(edge))
        places.append(T @ turned)
        bodies.append(tree.body(edge, {other.name for other in path}, turned))
        T = turned.T  # the inverse of a rotation
    if not joints:
        raise PlanError([f"{tree.where}: no joint moves between {base!r} and {tip!r}; choose other links"])
    chain = Chain(
        name=name or tree.name,
        joints=tuple(joint.name for joint in joints),
        prismatic=tuple(joint.prismatic for joint in joints),
        fixed=np.array(places),
        T_last_flange=T,
    )
    warnings = [limit_warning(source, joint) for joint in joints]
    reach = sum(float(np.linalg.norm(T[:3, 3])) for T in (*places, T))
    if reach > MAX_REACH_M:
        warnings.append(
            f"{tree.where}: its origins from {base} to {path[-1].child} add up to {reach:.0f} m, which looks like"
            " millimetres; a URDF is in metres: divide them by 1000"
        )
    for edge, body in zip(moving, bodies, strict=True):
        if body is not None and (why := lopsided_inertia(body.tensor)) is not None:
            warnings.append(f"{tree.where}: link {edge.child}, with what it carries: no body has {why}; correct it")
    return UrdfArm(chain, tuple(joints), tuple(bodies), tuple(filter(None, warnings)))


def limit_warning(source: str | Path, joint: Joint) -> str | None:
    """A warning about the stops of a joint if they look like degrees or millimetres; else None.

    Args:
        source: path of the file, or its text.
        joint: as `from_urdf` read it.
    """
    most, unit, looks = (MAX_STOP_M, "m", "millimetres") if joint.prismatic else (MAX_STOP_RAD, "rad", "degrees")
    if max(-joint.q_min, joint.q_max) <= most:
        return None
    return (
        f"{source_name(source)}: {joint.name}: <limit> from {joint.q_min:g} to {joint.q_max:g} {unit} looks like"
        f" {looks}; correct it, or set min_{joint.unit} and max_{joint.unit} of the joint"
    )
