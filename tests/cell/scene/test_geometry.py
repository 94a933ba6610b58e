"""Poses from millimetres and degrees, against scipy and by hand."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from canprobe.cell.scene.geometry import T_base_object, T_flange_probe, scan_axes, true_object
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import ObjectSettings, ProbeSettings, TaskSettings
from canprobe.mechanics.robot.denavit_hartenberg import rotation_rpy


@pytest.mark.parametrize("angles", [(0.3, 0, 0), (0, 0.4, 0), (0, 0, -0.5), (0.3, -0.4, 2.5), (-3, 1.5, 0.1)])
def test_rotation_is_about_fixed_axes_xyz(angles):
    np.testing.assert_allclose(rotation_rpy(*angles), Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-15)


def test_object_frame_in_metres():
    T = T_base_object(ObjectSettings("plane", position_mm=(-120, 10, 374), rotation_deg=(0, 0, 90)))
    np.testing.assert_allclose(T, [[0, -1, 0, -0.12], [1, 0, 0, 0.01], [0, 0, 1, 0.374], [0, 0, 0, 1]], atol=1e-15)


def test_a_positive_pitch_sinks_the_surface_ahead():
    plane = true_object(ObjectSettings("plane", position_mm=(0, 0, 0), rotation_deg=(0, 10, 0)))
    assert plane.closest(np.array([0.1, 0, 0])).distance == pytest.approx(0.1 * math.sin(math.radians(10)))


@pytest.mark.parametrize(
    ("name", "kappa"),
    [("cylinder", (1 / 0.036, 0)), ("sphere", (20, 20)), ("plane", (0, 0)), ("saddle", (1 / 0.06, -1 / 0.08))],
)
def test_packaged_objects_have_their_curvature_at_the_contact(name, kappa):
    scene = load_scene(name)
    foot = true_object(scene.object).closest(np.array(scene.task.start_mm) * 1e-3)
    np.testing.assert_allclose(foot.kappa, kappa, atol=1e-9)
    assert abs(foot.distance) < 1e-12
    assert foot.normal[2] > 0.99


@pytest.mark.parametrize("name", ["cylinder", "saddle"])
def test_the_first_principal_direction_lies_along_the_path(name):
    scene = load_scene(name)
    foot = true_object(scene.object).closest(np.array(scene.task.start_mm) * 1e-3)
    assert abs(foot.directions[0] @ scan_axes(scene.task)[0]) == pytest.approx(1)


def test_bowl_is_hollow():
    foot = true_object(ObjectSettings("bowl", radius_mm=50, position_mm=(0, 0, 0))).closest(np.array([0, 0, 0.01]))
    np.testing.assert_allclose(foot.kappa, (-20, -20))
    assert foot.distance == pytest.approx(0.01)


def test_scan_axes_are_heading_across_and_up():
    axes = scan_axes(dataclasses.replace(TaskSettings("scan"), heading_deg=30))
    np.testing.assert_allclose(axes, [[math.sqrt(0.75), 0.5, 0], [-0.5, math.sqrt(0.75), 0], [0, 0, 1]], atol=1e-15)


def test_scan_axes_lie_in_a_tilted_plane():
    task = dataclasses.replace(TaskSettings("scan"), heading_deg=0, approach_normal=(1, 0, 1))
    axes = scan_axes(task)
    s = math.sqrt(0.5)
    np.testing.assert_allclose(axes, [[s, 0, -s], [0, 1, 0], [s, 0, s]], atol=1e-15)


def test_probe_centre_lies_beyond_the_flange():
    np.testing.assert_allclose(T_flange_probe(ProbeSettings(centre_offset_mm=80)) @ [0, 0, 0, 1], [0, 0, 0.08, 1])
