"""The surface figure is drawn with and without what is optional."""

import dataclasses

import numpy as np
import pytest

from canprobe.cell.results.surface_figure import draw_map
from canprobe.mechanics.touch.objects import Sphere
from canprobe.mechanics.touch.surface import SurfaceMatrix
from canprobe.mechanics.touch.surface_map import LocalPatch, SurfaceMap

RADIUS = 0.05


def patch_on_ball(x, y, s, variance=1.0, rank=3):
    """An exact patch of a ball with its top at the origin."""
    surface = SurfaceMatrix.sphere(RADIUS).transformed(np.diag([1.0, -1.0, -1.0, 1.0]))
    T = surface.contact_frame(surface.project([x, y, 0.0]))
    P = variance * np.diag([1e-6, 1e-6, 1e-10, 1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    return LocalPatch(
        T_base_contact=T, S=SurfaceMatrix.sphere(RADIUS).S, K_covariance=4 * P[6:, 6:], S_covariance=P,
        pose_known=True, observed=[1, 1], combinations=np.eye(3)[:rank], t_s=s, travelled_m=s, distance_m=2e-3,
        innovation=1.0,
    )  # fmt: skip


@pytest.fixture
def two_passes():
    x = np.concatenate([np.linspace(-8e-3, 8e-3, 9), np.linspace(8e-3, -8e-3, 9)])
    patches = [patch_on_ball(a, 0.0, 2e-3 * i, variance=2.0 - 0.05 * i) for i, a in enumerate(x)]
    return SurfaceMap(patches=tuple(patches), path=np.array([p.point for p in patches]), method="ml")


def test_it_is_drawn_with_and_without_truth_and_crossings(two_passes, tmp_path):
    T = np.eye(4)
    draw_map(two_passes, tmp_path / "a.png", shape=Sphere(T, RADIUS), title="two passes")
    blind = dataclasses.replace(two_passes.patches[0], combinations=np.eye(3)[:2])
    draw_map(dataclasses.replace(two_passes, patches=(blind,)), tmp_path / "b.png")
    tiny = dataclasses.replace(two_passes, patches=(dataclasses.replace(blind, pose_known=False),))
    draw_map(tiny, tmp_path / "c.png")
    for name in ("a.png", "b.png", "c.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
