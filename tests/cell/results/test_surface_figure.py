"""The surface figure is drawn with and without what is optional."""

import numpy as np
import pytest

from canprobe.cell.results.surface_figure import draw_map
from canprobe.mechanics.touch.map.fit import fit_map
from canprobe.mechanics.touch.map.local_fits import PadLayer
from canprobe.mechanics.touch.map.noise import PAD_NOISE
from canprobe.mechanics.touch.map.surface_map import SurfaceMap
from canprobe.mechanics.touch.objects import Sphere

RADIUS = 0.05


@pytest.fixture(scope="module")
def contacts():
    """Two passes over a ball with its top at the origin."""
    x = np.concatenate([np.linspace(-8e-3, 8e-3, 90), np.linspace(8e-3, -8e-3, 90)])
    n = np.stack([x / RADIUS, np.repeat([0.0, 0.04], 90), np.ones(180)], axis=1)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return RADIUS * (n - [0.0, 0.0, 1.0]), n


def test_it_is_drawn_with_and_without_truth_path_and_common_errors(contacts, tmp_path):
    points, normals = contacts
    pad = SurfaceMap(PadLayer(0.04, 1e8), PAD_NOISE)
    pad.add(points, normals, np.full(len(points), 2.0))
    T = np.eye(4)
    T[2, 3] = -RADIUS
    shape = Sphere(T, RADIUS)
    draw_map(pad, tmp_path / "a.png", walked=points, shape=shape, title="two passes")
    draw_map(fit_map(points, normals), tmp_path / "b.png")
    draw_map(fit_map(points[:1], normals[:1]), tmp_path / "c.png")
    for name in ("a.png", "b.png", "c.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
