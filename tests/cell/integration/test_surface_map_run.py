"""A scan leaves its surface map: written, read back, and near the true object."""

from dataclasses import replace

import numpy as np
import pytest
from undrawn import undrawn_run

import canprobe
from canprobe.cell.results.summary import write_files
from canprobe.cell.scene.geometry import true_object


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """Six seconds over the cylinder: one loop of the weave and a little more; its files without figures."""
    scene = canprobe.load_scene("cylinder")
    scene = replace(scene, shape=replace(scene.shape, also=()))
    result = canprobe.run(scene, duration_s=6.0, files=False)
    out = tmp_path_factory.mktemp("scan")
    write_files(result, out)
    return result, out


def test_the_map_is_written_and_read_back(scan):
    result, out = scan
    assert canprobe.load_surface_map(out).equals(result.surface_map)
    assert result.surface_map.method == "recursive"
    along = 1e3 * result.surface_map.travelled
    assert 130 < along[-1] - along[0] < 160
    assert len(along) == int((along[-1] - along[0]) / 2.0) + 1  # a patch every 2 mm
    assert np.ptp(result.surface_map.path[:, 0]) < 0.06


def test_the_surface_is_near_the_true_object(scan):
    """Within the run's own figures: 0.1 mm and 1° everywhere on the path, half of it RMS (calibration, creep)."""
    result, _ = scan
    shape = true_object(result.plan.scene.object)
    feet = [shape.closest(p) for p in result.surface_map.path[::40]]
    answer = result.surface_map.closest([foot.point for foot in feet])
    heights = 1e3 * answer.height
    tilts = np.degrees(np.linalg.norm(np.cross(answer.normal, [foot.normal for foot in feet]), axis=1))
    assert np.isfinite(heights).all()
    assert np.sqrt(np.mean(np.square(heights))) < 0.05
    assert np.abs(heights).max() < 0.1
    assert np.sqrt(np.mean(np.square(tilts))) < 0.5
    away = result.surface_map.path[0] + np.array([0.03, 0.03, 0.0])
    assert result.surface_map.closest([away]).patches[0] == 0


def test_the_summary_says_what_was_tested(scan):
    result, _ = scan
    figures = result.summary["shape"]["map"]
    assert figures["patches"] == len(result.surface_map)
    assert figures["crossings"] >= 5  # the weave comes back mirrored and crosses itself five times in a loop
    for part in ("curvature", "normal", "height", "joint"):
        assert 0.0 <= figures[part]["share_p_below_0.05"] <= 1.0
    assert f"{figures['patches']} patches, {figures['crossings']} crossings" in result.text()


def test_without_a_shape_there_is_no_map(tmp_path):
    (tmp_path / "surface.npz").write_text("of an earlier run")
    result = undrawn_run(canprobe.load_scene("press"), duration_s=0.2, out=tmp_path, force=True)
    assert result.surface_map is None
    assert not (tmp_path / "surface.npz").exists()
    assert "surface.npz" not in result.plan.outputs
    assert {"surface.npz"} <= set(canprobe.plan(canprobe.load_scene("sphere")).outputs)
