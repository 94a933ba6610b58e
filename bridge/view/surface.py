"""The recovered surface in the browser: answers of the estimator blended into one surface, which grows with them."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from canprobe.lab.bridge.view.instants import JudgedAnswer
from canprobe.lab.bridge.view.path import DeviationScale
from canprobe.lab.bridge.view.path_nodes import Parts
from canprobe.mechanics.touch.blend import REACH_M
from canprobe.mechanics.touch.meshing import Mesh
from canprobe.mechanics.touch.surface_map import SPACING_M, LocalPatch, SurfaceMap
from canprobe.mechanics.types import Floats

CELL_M = 1e-3
"""Side of a triangle of the surface, m."""
LIFT_M = 3e-4
"""Distance outward from the true surface, m, so that the two do not flicker through each other."""


class BlendedSurface:
    """Answers as one surface: of those within `SPACING_M` of each other the one with the least deviation.

    Args:
        scale: scale of the colours, which show the stated deviation of K, 1/m.
    """

    def __init__(self, scale: DeviationScale) -> None:
        self._scale = scale
        self._answers: list[JudgedAnswer] = []

    def __bool__(self) -> bool:
        return bool(self._answers)

    def add(self, answer: JudgedAnswer) -> bool:
        """Take an answer; returns whether it has changed the surface."""
        if not (np.isfinite(answer.sigma) and np.isfinite(answer.patch.K).all()):
            return False
        point = _point(answer)
        near = [a for a in self._answers if float(np.linalg.norm(_point(a) - point)) < SPACING_M]
        if any(a.sigma <= answer.sigma for a in near):
            return False
        self._answers = [*(a for a in self._answers if a not in near), answer]
        return True

    def mesh(self) -> tuple[Mesh, NDArray[np.uint8]]:
        """The surface so far, and the colours of its vertices (n, 3)."""
        mesh = SurfaceMap(patches=tuple(map(_patch, self._answers)), path=np.zeros((0, 3))).mesh(cell=CELL_M)
        # a place is as well known as the best answer in reach
        sigmas = np.array([answer.sigma for answer in self._answers])
        best = [sigmas[near].min(initial=math.inf) for near in _near(mesh.vertices, self._answers)]
        return mesh, self._scale.colours(np.array(best))


def _near(vertices: Floats, answers: Sequence[JudgedAnswer]) -> list[list[int]]:
    """Find for each vertex (n, 3) the indices of the answers within `REACH_M`."""
    tree = cKDTree([_point(answer) for answer in answers])
    return [tree.query_ball_point(vertex, REACH_M) for vertex in vertices]


def _point(answer: JudgedAnswer) -> Floats:
    return answer.patch.T_base_contact[:3, 3]


def _patch(answer: JudgedAnswer) -> LocalPatch:
    """An answer as a patch of a map, with the part that is shown: its shape, without the uncertainty of its place."""
    patch, S, covariance = answer.patch, np.zeros((4, 4)), np.zeros((9, 9))
    S[:2, :2], S[2, 3], S[3, 2] = 0.5 * patch.K, -0.5, -0.5
    covariance[6:, 6:] = 0.25 * patch.covariance
    return LocalPatch(
        T_base_contact=patch.T_base_contact, S=S, K_covariance=patch.covariance, S_covariance=covariance,
        pose_known=False, observed=np.ones(2), combinations=np.eye(3), t_s=0.0, travelled_m=0.0, distance_m=REACH_M,
        innovation=1.0,
    )  # fmt: skip


class GrowingSurface:
    """A surface that grows while the cell runs.

    Args:
        api: viser's scene.
        scale: scale of the colours.
    """

    def __init__(self, api: Any, scale: DeviationScale) -> None:
        self._api, self._surface, self._grown = api, BlendedSurface(scale), False

    def add(self, answer: JudgedAnswer) -> None:
        """Take an answer."""
        self._grown |= self._surface.add(answer)

    def refresh(self) -> None:
        """Send the surface if it has changed."""
        if self._grown:
            mesh, colours = self._surface.mesh()
            _add(self._api, "/surface", mesh, mesh.triangles, colours)
            self._grown = False


STAGES = 40
"""Number of parts of a recorded surface."""


class LoadedSurface(Parts):
    """The surface of a recorded run at its end, shown as far as it was touched by an instant.

    Args:
        api: viser's scene.
        answers: estimates of the run, by rising time, each with its instant, s.
        scale: scale of the colours.
    """

    def __init__(self, api: Any, answers: Iterable[tuple[float, JudgedAnswer]], scale: DeviationScale) -> None:
        surface, times, shown = BlendedSurface(scale), list[float](), list[JudgedAnswer]()
        for t_s, answer in answers:
            surface.add(answer)
            times.append(t_s)
            shown.append(answer)
        super().__init__()
        if not surface:
            return
        mesh, colours = surface.mesh()
        first = np.array([min(near, default=len(times) - 1) for near in _near(mesh.vertices, shown)])
        stage = first[mesh.triangles].max(axis=1) * STAGES // len(times)
        for number in np.unique(stage):
            node = _add(api, f"/surface/{number:02d}", mesh, mesh.triangles[stage == number], colours, visible=False)
            self.add(times[-(-number * len(times) // STAGES)], node)


def _add(api: Any, name: str, mesh: Mesh, triangles: Any, colours: Any, *, visible: bool = True) -> Any:
    trimesh = importlib.import_module("trimesh")
    used, index = np.unique(triangles, return_inverse=True)
    solid = trimesh.Trimesh(
        mesh.vertices[used] + LIFT_M * mesh.normals[used], index.reshape(-1, 3), vertex_colors=colours[used],
        vertex_normals=mesh.normals[used], process=False,
    )  # fmt: skip
    return api.add_mesh_trimesh(name, solid, visible=visible, cast_shadow=False)
