"""The links of an arm: the solids of its URDF, with the meshes that are found beside it, or simple ones.

Where a link has nothing to show, or one of its meshes is missing or cannot be read, its simple solids are drawn
(`description`), and a line says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.scene.hardware import ArmSettings
from canprobe.cell.scene.urdf_solids import MeshError, read_mesh
from canprobe.errors import PlanError
from canprobe.lab.bridge.description import WHITE, simple_solids, urdf_solids
from canprobe.lab.bridge.view.meshes import SECTORS, trimesh
from canprobe.mechanics.robot.chain import Chain
from canprobe.mechanics.robot.urdf_visuals import Visual

_NAMED = 3
"""Number of missing meshes that a line names."""


@dataclass(frozen=True, slots=True)
class Part:
    """One solid of one colour, fixed to a link.

    Attributes:
        name: name, unique in the arm.
        frame: 0 for the base, i for the frame behind joint i.
        mesh: its triangles in that frame, m, a `trimesh.Trimesh`.
        colour: RGB, 0–255.
    """

    name: str
    frame: int
    mesh: Any
    colour: tuple[int, int, int]


def arm_links(arm: ArmSettings, chain: Chain) -> tuple[list[Part], list[str]]:
    """Solids of an arm, and lines about parts of its URDF that cannot be drawn.

    Args:
        arm: arm of the scene.
        chain: kinematic chain of that arm.
    """
    behind = (np.eye(4), *chain.fixed[1:], chain.T_last_flange)  # where a part's frame stands in that of its joint

    def placed(name: str, solid: Visual) -> Iterator[Part]:
        T = np.linalg.inv(behind[solid.joint]) @ solid.T
        for number, (mesh, colour) in enumerate(_meshes(arm, solid), start=1):
            yield Part(f"{name}_{number}", solid.joint, mesh.apply_transform(T), solid.colour or colour)

    try:
        solids, lines = urdf_solids(arm), list[str]()
    except PlanError as error:
        solids, lines = [], [f"{error}: simple links are drawn"]
    parts: list[Part] = []
    lost: dict[str, list[Visual]] = {}
    for number, solid in enumerate(solids, start=1):
        try:
            parts += placed(f"solid_{number}", solid)
        except MeshError as error:
            lost.setdefault(str(error), []).append(solid)
    bare = {solid.joint for some in lost.values() for solid in some}
    bare |= set(range(chain.n + 1)) - {part.frame for part in parts}
    for number, solid in enumerate(simple_solids(chain), start=1):
        if solid.joint in bare:
            parts += placed(f"simple_{number}", solid)
    return parts, [*lines, *_lines(Path(arm.urdf or ""), lost)]


def _lines(urdf: Path, lost: dict[str, list[Visual]]) -> Iterator[str]:
    for why, visuals in lost.items():
        names = list(dict.fromkeys(visual.mesh.rpartition("/")[2] or visual.kind for visual in visuals))
        more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
        yield f"{urdf.name}: {', '.join(names[:_NAMED])}{more}: {why}; simple links are drawn"


def _meshes(arm: ArmSettings, solid: Visual) -> list[tuple[Any, tuple[int, int, int]]]:
    """Triangles and colours of one solid, in its own frame."""
    creation = trimesh().creation
    if solid.kind == "box":
        return [(creation.box(solid.size), WHITE)]
    if solid.kind == "cylinder":
        return [(creation.cylinder(*solid.size, sections=SECTORS), WHITE)]
    if solid.kind == "sphere":
        return [(creation.icosphere(radius=solid.size[0]), WHITE)]
    return [(body, _colour(body)) for body in read_mesh(Path(arm.urdf or ""), solid)]


def _colour(body: Any) -> tuple[int, int, int]:
    """One colour for a body: of its material, or the mean of its faces; white where the file has none."""
    visual = body.visual
    if visual.kind is None:
        return WHITE
    colour = visual.material.main_color if visual.kind == "texture" else visual.main_color
    red, green, blue = (int(x) for x in np.asarray(colour)[:3])
    return red, green, blue
