"""Poses from millimetres and degrees, against scipy and by hand."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from canprobe.cell.scene.geometry import T_base_object, scan_axes, true_object
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import ObjectSettings, TaskSettings
from canprobe.mechanics.robot.denavit_hartenberg import rotation_rpy


@pytest.mark.parametrize("angles", [(0.3, -0.4, 2.5), (-3, 1.5, 0.1)])
def test_rotation_is_about_fixed_axes_xyz(angles):
    np.testing.assert_allclose(rotation_rpy(*angles), Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-15)


def test_object_frame_in_metres():
    T = T_base_object(ObjectSettings("plane", position_mm=(-120, 10, 374), rotation_deg=(0, 0, 90)))
    np.testing.assert_allclose(T, [[0, -1, 0, -0.12], [1, 0, 0, 0.01], [0, 0, 1, 0.374], [0, 0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize(("name", "kappa"), [("cylinder", (1 / 0.036, 0)), ("saddle", (1 / 0.06, -1 / 0.08))])
def test_packaged_objects_have_their_curvature_at_the_contact_the_larger_one_along_the_path(name, kappa):
    scene = load_scene(name)
    foot = true_object(scene.object).closest(np.array(scene.task.start_mm) * 1e-3)
    np.testing.assert_allclose(foot.kappa, kappa, atol=1e-9)
    assert abs(foot.distance) < 1e-12
    assert foot.normal[2] > 0.99
    assert abs(foot.directions[0] @ scan_axes(scene.task)[0]) == pytest.approx(1)


def test_scan_axes_lie_in_a_tilted_plane():
    task = dataclasses.replace(TaskSettings("scan"), heading_deg=0, approach_normal=(1, 0, 1))
    axes = scan_axes(task)
    s = math.sqrt(0.5)
    np.testing.assert_allclose(axes, [[s, 0, -s], [0, 1, 0], [s, 0, s]], atol=1e-15)
