"""A scan leaves its surface map: written, read back, and near the true object."""

from dataclasses import replace

import numpy as np
import pytest
from undrawn import undrawn_run

import canprobe
from canprobe.cell.results.summary import writers_of
from canprobe.cell.scene.geometry import true_object
from canprobe.mechanics.touch.map import nodes


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """Four seconds over the cylinder; its files without figures."""
    scene = canprobe.load_scene("cylinder", {"task.clearance_mm": 0.3, "cycle.rate_hz": 200.0, "shape.also": []})
    result = canprobe.run(scene, bus="direct", duration_s=4.0, files=False)
    out = tmp_path_factory.mktemp("scan")
    for write in writers_of(result):
        write(out)
    return result, out


def test_the_map_is_written_and_read_back(scan):
    result, out = scan
    again = canprobe.load_surface_map(out)
    places = result.surface_map.points[::7]
    np.testing.assert_array_equal(again.nodes.rows, result.surface_map.nodes.rows)
    np.testing.assert_array_equal(again.distance(places), result.surface_map.distance(places))
    assert again.stiffness == result.surface_map.stiffness
    assert again.nodes.rows[:, nodes.COUNT].sum() == len(result.contacts)
    assert 65 < len(again) < 110  # a node for each of 95 mm of path, less where it crosses itself


def test_the_surface_is_the_true_object_within_its_sigma(scan):
    result, _ = scan
    shape = true_object(result.plan.scene.object)
    feet = [shape.closest(p) for p in result.surface_map.points[::5]]
    true = np.array([foot.point for foot in feet])
    height, sigma = result.surface_map.distance(true)
    assert np.sqrt(np.mean(height**2)) < 20e-6
    assert np.mean(np.abs(height) < 3.0 * sigma) > 0.95
    normal, _ = result.surface_map.normal(true)
    assert np.linalg.norm(np.cross(normal, [foot.normal for foot in feet]), axis=1).max() < 5e-3
    bent = result.surface_map.curvature(true)
    tensors = [(foot.directions.T * foot.kappa) @ foot.directions for foot in feet]
    assert np.sqrt(np.mean((bent.tensor - tensors) ** 2)) < 0.5
    away = result.surface_map.points[0] + np.array([0.03, 0.03, 0.0])
    assert np.isnan(result.surface_map.distance([away])).all()


def test_the_summary_says_how_good_it_is(scan):
    result, _ = scan
    figures = result.summary["shape"]["map"]
    assert (figures["nodes"], figures["contacts"]) == (len(result.surface_map), len(result.contacts))
    assert figures["rms_error_um"] < 20 and figures["within_2_sigma_fraction"] > 0.9
    assert figures["disagree_fraction"] < 0.1
    assert figures["stiffness_n_m3"] == pytest.approx(result.plan.setup.truth.stiffness, rel=0.1)
    assert set(figures["common"]) == {"lag_um", "pad_scale_percent", "pad_x_um", "pad_y_um"}
    assert f"{figures['contacts']} contacts in {figures['nodes']} nodes, σ " in result.text()


@pytest.mark.slow(reason="seven more seconds of a scan")
def test_answers_are_joined_with_earlier_passes_only_where_a_scene_asks(scan):
    """Ground is known 40 mm, two memories, behind the contact; the weave crosses itself, and a loop takes 5.8 s."""
    plain, _ = scan
    scene = replace(plain.plan.scene, shape=replace(plain.plan.scene.shape, revisit=True))
    asked = canprobe.run(scene, duration_s=7.0, bus="direct", files=False)
    notes = [str(record.estimate.notes) for record in asked.estimates["recursive"]]
    back = ["touched before" in note for note in notes]
    assert sum(back) > 15 and not any(back[:35])
    assert not any("touched before" in str(record.estimate.notes) for record in plain.estimates["recursive"])


def test_without_a_shape_there_is_no_map(tmp_path):
    (tmp_path / "surface.npz").write_text("of an earlier run")
    result = undrawn_run(
        canprobe.load_scene("press", {"task.clearance_mm": 0.3, "bus.timed": False}),
        duration_s=0.1,
        out=tmp_path,
        force=True,
    )
    assert result.surface_map is None
    assert not (tmp_path / "surface.npz").exists()
    assert "surface.npz" not in result.plan.outputs
    assert {"surface.npz"} <= set(canprobe.plan(canprobe.load_scene("sphere")).outputs)
