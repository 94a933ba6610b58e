"""The links of an arm from its URDF: meshes that are found beside it, and plain solids.

Meshes (STL, DAE, OBJ) are read by trimesh (extra `view`). Where a link has nothing to show, or one of its
meshes is missing or cannot be read, the simple link of `canprobe.lab.bridge.view.bodies` is drawn, and a line says so.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.scene.geometry import transform
from canprobe.cell.scene.hardware import ArmSettings
from canprobe.errors import PlanError, needed_module
from canprobe.lab.bridge.view.bodies import WHITE, Part, arm_parts
from canprobe.lab.bridge.view.meshes import TriangleMesh
from canprobe.mechanics.robot.chain import Chain
from canprobe.mechanics.robot.urdf_visuals import Visual, find_mesh, visuals_of
from canprobe.mechanics.types import Floats

_NAMED = 3
"""Number of missing meshes that a line names."""
_FORMATS = (".stl", ".dae", ".obj")


def arm_links(arm: ArmSettings, chain: Chain) -> tuple[list[Part], list[str]]:
    """Solids of an arm, and lines about parts of its URDF that cannot be drawn.

    Args:
        arm: arm of the scene.
        chain: kinematic chain of that arm.
    """
    plain = arm_parts(chain)
    if arm.urdf is None:
        return plain, []
    urdf = Path(arm.urdf)
    try:
        visuals = visuals_of(urdf, arm.base, arm.tip)
    except PlanError as error:
        return plain, [f"{error}: simple links are drawn"]
    behind = (np.eye(4), *chain.fixed[1:], chain.T_last_flange)  # where a part's frame stands in that of its joint
    mount = transform(arm.mount_mm, arm.mount_deg)
    parts: list[Part] = []
    lost: dict[str, list[Visual]] = {}
    for visual in visuals:
        T = (mount if visual.joint == 0 else np.linalg.inv(behind[visual.joint])) @ visual.T
        try:
            for mesh, colour in _solids(urdf, visual):
                name = f"solid_{len(parts) + 1}"
                parts.append(Part(name, visual.joint, mesh.moved(T), visual.colour or colour, flat=True))
        except _LostError as error:
            lost.setdefault(str(error), []).append(visual)
    simple = {visual.joint for visuals in lost.values() for visual in visuals}
    simple |= set(range(chain.n + 1)) - {part.frame for part in parts}
    return [*(part for part in plain if part.frame in simple), *parts], list(_lines(urdf, lost))


def _lines(urdf: Path, lost: dict[str, list[Visual]]) -> Iterator[str]:
    for why, visuals in lost.items():
        names = list(dict.fromkeys(visual.mesh.rpartition("/")[2] or visual.kind for visual in visuals))
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        yield f"{urdf.name}: {', '.join(names[:_NAMED])}{more}: {why}; simple links are drawn"


class _LostError(Exception):
    """Why a solid cannot be drawn."""


def _solids(urdf: Path, visual: Visual) -> list[tuple[TriangleMesh, tuple[int, int, int]]]:
    """Triangles and colours of one solid, in its own frame."""
    trimesh = needed_module("trimesh", "view", "the view needs trimesh; type:")
    size: Sequence[float] = visual.size
    if visual.kind == "box":
        return [(_mesh(trimesh.creation.box(size)), WHITE)]
    if visual.kind == "cylinder":
        return [(_mesh(trimesh.creation.cylinder(*size)), WHITE)]
    if visual.kind == "sphere":
        return [(_mesh(trimesh.creation.icosphere(radius=size[0])), WHITE)]
    if visual.kind != "mesh":
        raise _LostError("not a solid of a URDF")
    path = find_mesh(urdf, visual.mesh)
    if path is None:
        raise _LostError("not found beside the URDF")
    if path.suffix.lower() not in _FORMATS:
        raise _LostError(f"expected {', '.join(_FORMATS)}")
    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # it logs tracebacks of what it does without
    try:
        bodies = trimesh.load_scene(path).dump()
    except Exception as error:  # whatever a reader of foreign files raises, the view goes on
        raise _LostError(f"cannot be read: {error or type(error).__name__}") from error
    solid = [body for body in bodies if len(getattr(body, "faces", ()))]
    if not solid:  # of a damaged STL, trimesh makes a body of nothing
        raise _LostError("cannot be read: it holds no facet")
    return [(_scaled(_mesh(body), np.array(size)), _colour(body)) for body in solid]


def _mesh(body: Any) -> TriangleMesh:
    body.merge_vertices(merge_tex=True, merge_norm=True)
    return TriangleMesh(np.array(body.vertices, np.float64), np.array(body.faces, np.int64))


def _scaled(mesh: TriangleMesh, scale: Floats) -> TriangleMesh:
    faces = mesh.faces if scale.prod() > 0.0 else mesh.faces[:, ::-1]  # mirrored, it would be inside out
    return TriangleMesh(mesh.vertices * scale, faces)


def _colour(body: Any) -> tuple[int, int, int]:
    """One colour for a body: of its material, or the mean of its faces; white where the file has none."""
    visual = body.visual
    if visual.kind is None:
        return WHITE
    colour = visual.material.main_color if visual.kind == "texture" else visual.main_color
    red, green, blue = (int(x) for x in np.asarray(colour)[:3])
    return red, green, blue
