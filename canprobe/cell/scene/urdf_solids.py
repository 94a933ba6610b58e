"""Solids of a URDF as bodies: its meshes, and spheres round the links from what it has for collisions.

Meshes (STL, DAE, OBJ) are read by trimesh (extra `view`).

A solid is cut into slices across its longest side, and a sphere is put round what each slice holds: of a mesh the
vertices in it, and the points where edges pass its faces. So the spheres contain what is between its vertices, too.
"""

from __future__ import annotations

import logging
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.errors import UsageError, needed_module
from canprobe.mechanics.robot.chain import Chain
from canprobe.mechanics.robot.urdf_visuals import Visual, find_mesh, visuals_of
from canprobe.mechanics.types import Floats

MAX_SPHERES = 8
"""Most spheres round one solid."""
SLICES = 2.0
"""Slices in a length of a solid that is its width."""
ROUNDING_M = 1e-9
"""Length by which rounding may move a point, m."""
_FORMATS = (".stl", ".dae", ".obj")


class MeshError(ValueError):
    """Why a solid of a URDF cannot be read."""


def read_mesh(urdf: Path, solid: Visual) -> list[Any]:
    """Bodies of a mesh in the frame of its solid, each a `trimesh.Trimesh`, m.

    Args:
        urdf: path of the URDF that names it.
        solid: a solid of kind "mesh".

    Raises:
        MeshError: it is another kind, or its file is missing or cannot be read.
        UsageError: trimesh is not installed.
    """
    if solid.kind != "mesh":
        raise MeshError("not a solid of a URDF")
    if (path := find_mesh(urdf, solid.mesh)) is None:
        raise MeshError("not found beside the URDF")
    if path.suffix.lower() not in _FORMATS:
        raise MeshError(f"expected {', '.join(_FORMATS)}")
    trimesh = needed_module("trimesh", "view", "a mesh of a URDF needs trimesh; type:")
    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # it logs tracebacks of what it does without
    try:
        bodies = [body for body in trimesh.load_scene(path).dump() if len(getattr(body, "faces", ()))]
    except Exception as error:  # whatever a reader of foreign files raises, the caller goes on
        raise MeshError(f"cannot be read: {error or type(error).__name__}") from error
    if not bodies:  # of a damaged STL, trimesh makes a body of nothing
        raise MeshError("cannot be read: it holds no facet")
    for body in bodies:
        body.merge_vertices(merge_tex=True, merge_norm=True)
    return [body.apply_scale(solid.size) for body in bodies]


def link_spheres(urdf: Path, base: str | None, tip: str | None, chain: Chain) -> tuple[Floats, tuple[str, ...]]:
    """Spheres round the collision solids of an arm, from joint 2 on.

    Args:
        urdf: path of the file.
        base, tip: names of links, as for `from_urdf`.
        chain: the arm; its flange may be another than the tip.

    Returns:
        Rows (m, 5): number of the joint whose link it is, centre in the frame behind that joint (`link_frames`), m, and
        radius, m. And a line that names the links with a solid that cannot be read, which have no spheres, if any.

    Raises:
        PlanError: a solid lacks its numbers.
    """
    behind = (*chain.fixed[1:], chain.T_last_flange)
    rows: list[tuple[float, ...]] = []
    lost: dict[int, str] = {}
    for solid in (solid for solid in visuals_of(urdf, base, tip, "collision") if solid.joint > 1):
        try:
            spheres = _spheres_round(solid, urdf)
        except (ValueError, UsageError) as error:
            lost.setdefault(solid.joint, f"{solid.mesh or solid.kind}: {error}")
            continue
        T = np.linalg.inv(behind[solid.joint - 1]) @ solid.T
        rows += [(solid.joint, *(T[:3, :3] @ centre + T[:3, 3]), radius) for centre, radius in spheres]
    found = np.array([row for row in rows if row[0] not in lost]).reshape(-1, 5)
    if not lost:
        return found, ()
    joints, (why, *_) = ", ".join(map(str, lost)), lost.values()
    return found, (f"{urdf.name}: collision of joint {joints}: {why}; [keep_out] takes link_radius_mm there",)


def _spheres_round(solid: Visual, urdf: Path) -> list[tuple[Floats, float]]:
    """Centres (3,) and radii of spheres round one solid, in its frame, m.

    Raises:
        ValueError, UsageError: its mesh cannot be read.
    """
    if solid.kind not in ("box", "cylinder", "sphere"):
        body, *others = read_mesh(urdf, solid)
        whole = sum(others, start=body)
        return mesh_spheres(whole.vertices, whole.edges_unique)
    axis, length, across = 2, 0.0, solid.size[0]  # radius of the section across that axis
    if solid.kind == "cylinder":
        length = solid.size[1]
    elif solid.kind == "box":
        axis, length = int(np.argmax(solid.size)), max(solid.size)
        across = 0.5 * float(np.linalg.norm(np.delete(solid.size, axis)))
    cuts = _cuts(-0.5 * length, length, 2.0 * across)
    radius = math.hypot(across, 0.5 * (cuts[1] - cuts[0]))
    return [(0.5 * (a + b) * np.eye(3)[axis], radius) for a, b in pairwise(cuts)]


def mesh_spheres(points: Floats, edges: Floats) -> list[tuple[Floats, float]]:
    """Centres (3,) and radii of spheres, `MAX_SPHERES` at most, that contain a solid, m.

    Args:
        points: (k, 3) its vertices, m.
        edges: (e, 2) numbers of the vertices that its edges connect.
    """
    size = np.ptp(points, axis=0)
    axis = int(size.argmax())
    cuts = _cuts(points[:, axis].min(), size[axis], np.sort(size)[1])
    start, way = points[edges[:, 0]], points[edges[:, 1]] - points[edges[:, 0]]
    across = np.abs(way[:, axis]) > ROUNDING_M
    start, way = start[across], way[across]
    shares = (cuts[1:-1, None] - start[:, axis]) / way[:, axis]
    cut, edge = np.nonzero((shares >= 0.0) & (shares <= 1.0))
    points = np.vstack([points, start[edge] + shares[cut, edge, None] * way[edge]])
    spheres = []
    for low, high in pairwise(cuts):
        inside = points[(points[:, axis] >= low - ROUNDING_M) & (points[:, axis] <= high + ROUNDING_M)]
        if len(inside):
            centre = 0.5 * (inside.min(axis=0) + inside.max(axis=0))
            spheres.append((centre, float(np.linalg.norm(inside - centre, axis=1).max()) + ROUNDING_M))
    return spheres


def _cuts(low: float, length: float, width: float) -> Floats:
    """Places of the faces of slices along a length, m."""
    number = min(MAX_SPHERES, max(1, math.ceil(SLICES * length / max(width, ROUNDING_M))))
    return low + length * np.linspace(0.0, 1.0, number + 1)
