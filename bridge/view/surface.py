"""The recovered surface in the browser: the map of all contacts, which grows with them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from canprobe.lab.bridge.sample import ContactFrame
from canprobe.lab.bridge.view.meshes import trimesh
from canprobe.lab.bridge.view.path import DeviationScale, Parts, Trail
from canprobe.mechanics.touch import PAD_NOISE, Mesh, SurfaceMap
from canprobe.mechanics.touch.map.surface_map import REACH_M
from canprobe.mechanics.types import Floats

CELL_M, NODES_IN_DETAIL = 1e-3, 10_000
"""Side of a triangle of the surface, m, and nodes of a map beyond which triangles grow, so that they are no more."""
LIFT_M = 3e-4
"""Distance outward from the true surface, m, so that the two do not flicker through each other."""


def map_of_points(probe_radius: float) -> SurfaceMap:
    """An empty map for contact points and normals that a pad of a radius (m) has reported: the squeeze is off."""
    turned = math.hypot(PAD_NOISE.normal, PAD_NOISE.lateral / probe_radius)
    return SurfaceMap(None, replace(PAD_NOISE, normal=turned, common=(0.0, 0.0, 0.0, 0.0)))


def drawn(surface_map: SurfaceMap, scale: DeviationScale) -> tuple[Mesh, NDArray[np.uint8]]:
    """Triangles of a map, and the colours of its vertices (n, 3): the deviation of K or height that it states there."""
    mesh = surface_map.mesh(cell=CELL_M * max(1.0, math.sqrt(len(surface_map) / NODES_IN_DETAIL)))
    if scale.of_height:
        return mesh, scale.colours(1e6 * mesh.sigma_relative)
    V = surface_map.curvature(mesh.vertices).covariance
    return mesh, scale.colours(np.sqrt(V[:, 0, 0] + 2.0 * V[:, 1, 1] + V[:, 2, 2]))


class GrowingSurface:
    """A surface that grows while the cell runs.

    Args:
        api: viser's scene.
        scale: scale of the colours.
        probe_radius: radius of the probe, m.
    """

    def __init__(self, api: Any, scale: DeviationScale, probe_radius: float) -> None:
        self._api, self._scale, self._map = api, scale, map_of_points(probe_radius)
        self._new: list[ContactFrame] = []

    def add(self, contact: ContactFrame) -> None:
        """Take a contact."""
        self._new.append(contact)

    def refresh(self) -> None:
        """Send the surface if it has changed."""
        if self._new:
            self._map.add([one.point for one in self._new], [one.normal for one in self._new])
            self._new.clear()
            mesh, colours = drawn(self._map, self._scale)
            _add(self._api, "/surface", mesh, mesh.triangles, colours)


STAGES = 40
"""Number of parts of a recorded surface."""


class LoadedSurface(Parts):
    """The surface of a recorded run at its end, shown as far as it was touched by an instant.

    Args:
        api: viser's scene.
        surface_map: map of the run; None: nothing was touched.
        trail: path of the contact in the run.
        scale: scale of the colours.
    """

    def __init__(self, api: Any, surface_map: SurfaceMap | None, trail: Trail, scale: DeviationScale) -> None:
        super().__init__()
        if surface_map is None or not len(trail):
            return
        mesh, colours = drawn(surface_map, scale)
        first = _first_touched(mesh.vertices, trail)
        times = np.linspace(trail.times[0], trail.times[-1], STAGES + 1)[1:]
        stage = np.searchsorted(times, first[mesh.triangles].max(axis=1))
        for number in np.unique(stage):
            node = _add(api, f"/surface/{number:02d}", mesh, mesh.triangles[stage == number], colours, visible=False)
            self.add(float(times[min(number, STAGES - 1)]), node)


def _first_touched(vertices: Floats, trail: Trail) -> Floats:
    """(n,) the instant of the first contact within reach of each vertex (n, 3), s; of the last where none is."""
    tree = cKDTree([segment[1] for segment in trail.segments])
    near = (tree.query_ball_point(vertex, REACH_M) for vertex in vertices)
    return np.array([trail.times[min(one, default=-1)] for one in near])


def _add(api: Any, name: str, mesh: Mesh, triangles: Any, colours: Any, *, visible: bool = True) -> Any:
    used, index = np.unique(triangles, return_inverse=True)
    solid = trimesh().Trimesh(
        mesh.vertices[used] + LIFT_M * mesh.normals[used], index.reshape(-1, 3), vertex_colors=colours[used],
        vertex_normals=mesh.normals[used], process=False,
    )  # fmt: skip
    return api.add_mesh_trimesh(name, solid, visible=visible, cast_shadow=False)
