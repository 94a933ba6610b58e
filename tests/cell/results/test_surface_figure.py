"""The figures of a run: drawn with and without what is optional, and what their titles say."""

from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import canprobe
from canprobe.cell.results.figures import draw_run
from canprobe.cell.results.picture import sheet
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


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are drawn, in the place of files."""
    figures = []

    @contextmanager
    def kept(path, title, height_in):
        with sheet(title, height_in) as figure:
            yield figure
            figures.append(figure)

    monkeypatch.setattr("canprobe.cell.results.surface_figure.picture", kept)
    monkeypatch.setattr("canprobe.cell.results.figures.picture", kept)
    return figures


def titles(part):
    return [axes.get_title("left") for axes in part.axes] + [title for one in part.subfigs for title in titles(one)]


@pytest.mark.parametrize("apart_m", [0.0, 5e-4])
def test_contacts_are_said_to_disagree_only_where_some_do(apart_m, contacts, drawn):
    points, normals = contacts
    again = points + np.array((0.0, 0.0, apart_m))
    draw_map(fit_map(np.concatenate((points, again)), np.concatenate((normals, normals))), Path("none.png"))
    assert ("contacts agree everywhere" in titles(drawn[0])) == (apart_m == 0.0)
    assert any(title.startswith("where contacts disagree") for title in titles(drawn[0])) == (apart_m > 0.0)


def test_the_report_has_the_figures_of_the_run_in_its_title_and_the_scan_fills_its_panel(drawn):
    result = canprobe.run(
        "cylinder",
        {"outputs.figures": False, "shape.also": [], "task.clearance_mm": 0.3},
        bus="direct",
        duration_s=2.0,
        files=False,
    )
    draw_run(result, Path("none.png"))
    percent = result.summary["shape"]["kappa_rms_error_percent"]
    off = 100 * result.summary["contact"]["force_rms_error_n"] / 2.0
    title = drawn[0].get_suptitle()
    assert f"force off its target by {off:.1f} % · curvature by {percent:.1f} % (RMS)" in title
    drawn[0].canvas.draw()
    panel = drawn[0].subfigs[0].subfigs[0]
    box = panel.axes[0].get_tightbbox()
    assert box.width > 0.7 * panel.bbox.width and box.height > 0.6 * panel.bbox.height
