"""Meshes against a ball in closed form: on the surface, closed, oriented, and read back by another library."""

import math

import numpy as np
import pytest
import trimesh

from canprobe.errors import ResultsError, UsageError
from canprobe.mechanics.touch import fit_map
from canprobe.mechanics.touch.map.surface_map import REACH_M
from canprobe.mechanics.touch.meshing import Feet, mesh_of

RADIUS = 0.05


def ball(points, normals):
    """A map of exact contacts, which knows that they are exact."""
    return fit_map(points, normals, sigma_point=1e-6, sigma_normal=1e-5)


def band(pose, end=22e-3):
    """Three passes along a meridian of a sphere somewhere in space, 2 mm apart."""
    angle, side = np.meshgrid(np.arange(0.0, end, 0.25e-3) / RADIUS, np.array([-2e-3, 0.0, 2e-3]) / RADIUS)
    n = np.stack([np.sin(angle) * np.cos(side), np.sin(side), np.cos(angle) * np.cos(side)], axis=-1).reshape(-1, 3)
    n = n @ pose[:3, :3].T
    return pose[:3, 3] + RADIUS * n, n


def test_the_mesh_of_a_pass_is_a_band_on_the_ball(truth):
    pose = truth.any_pose(3)
    surface = ball(*band(pose))
    mesh = surface.mesh()
    out = mesh.vertices - pose[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), RADIUS, atol=5e-6)  # a mean over 1 mm is low
    np.testing.assert_allclose(mesh.normals, out / RADIUS, atol=2e-3)
    shape = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    assert shape.is_winding_consistent
    assert shape.body_count == 1
    assert np.einsum("ij,ij->i", shape.face_normals, mesh.normals[mesh.triangles[:, 0]]).min() > 0.99
    assert np.degrees(shape.face_angles.min()) > 10  # no slivers
    # 21 mm between nodes, 4 mm wide, and what is in reach to every side of it, but for up to two cells at the rim
    least, most = (21e-3 * (4e-3 + 2 * r) + 8e-3 * r + math.pi * r**2 for r in (REACH_M - 1e-3, REACH_M))
    assert least < shape.area < most
    distance, sigma = surface.distance(mesh.vertices)
    assert np.abs(distance).max() < 1e-7
    np.testing.assert_allclose(mesh.sigma, sigma, rtol=1e-3)


def test_what_is_added_elsewhere_leaves_the_triangles_where_they_were(truth):
    pose = truth.any_pose(3)
    p, n = band(pose)
    far, up = band(pose, 70e-3)
    away = np.linalg.norm(far[:, None] - p, axis=2).min(axis=1) > 18e-3
    before = ball(p, n).mesh(cell=1e-3)
    grown = ball(np.concatenate([p, far[away]]), np.concatenate([n, up[away]])).mesh(cell=1e-3)
    apart = np.linalg.norm(before.vertices[:, None] - grown.vertices, axis=2).min(axis=1)
    assert len(grown.vertices) > 1.5 * len(before.vertices)
    assert apart.max() < 1e-9


def test_a_ply_file_is_read_by_another_library(truth, tmp_path):
    mesh = ball(*band(truth.any_pose(3))).mesh(cell=1e-3)
    mesh.save_ply(tmp_path / "map.ply")
    read = trimesh.load(tmp_path / "map.ply", process=False)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-7)
    np.testing.assert_array_equal(read.faces, mesh.triangles)
    np.testing.assert_allclose(read.vertex_normals, mesh.normals, atol=1e-6)
    np.testing.assert_allclose(read.metadata["_ply_raw"]["vertex"]["data"]["sigma"], mesh.sigma, rtol=1e-6)
    with pytest.raises(ResultsError, match=r"none/map.ply: cannot be written: No such file"):
        mesh.save_ply(tmp_path / "none" / "map.ply")


def plane(points, half=0.0105):
    """A surface that lies on the corners of the lattice, as no scan does."""
    inside = (np.abs(points[:, :2]) < half).all(axis=1)
    height = np.where(inside, points[:, 2], math.nan)
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return Feet(points * [1.0, 1.0, 0.0], up, height, 0 * height, 0 * height)


def test_any_closest_point_can_be_meshed():
    mesh = mesh_of(plane, np.zeros((1, 3)), 1e-3)
    shape = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    assert shape.area == pytest.approx(19e-3**2)
    np.testing.assert_allclose(shape.face_normals[:, 2], 1.0)
    with pytest.raises(UsageError, match=r"cell: expected at least \S+ m for points so far away, got 1e-09"):
        mesh_of(plane, np.ones((1, 3)), 1e-9)


def test_without_a_surface_there_are_no_triangles(tmp_path):
    nothing = mesh_of(lambda points: plane(points, -1.0), np.zeros((1, 3)), 1e-3)
    assert (nothing.vertices.shape, nothing.triangles.shape, nothing.sigma.shape) == ((0, 3), (0, 3), (0,))
    nothing.save_ply(tmp_path / "nothing.ply")
    assert (tmp_path / "nothing.ply").read_bytes().endswith(b"end_header\n")
