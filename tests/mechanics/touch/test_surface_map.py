"""The map of local patches: what is kept of a path, the surface that it answers with, and its mesh."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh

from canprobe.errors import ResultsError, UsageError
from canprobe.mechanics.touch.blend import REACH_M, Feet
from canprobe.mechanics.touch.estimate.fit import fit_surface
from canprobe.mechanics.touch.meshing import mesh_of
from canprobe.mechanics.touch.surface import SurfaceMatrix
from canprobe.mechanics.touch.surface_map import UNSEEN_CURVATURE_SIGMA, LocalPatch, SurfaceMap, merge_patches, spaced

RADIUS = 0.05
SIGMA = {"sigma_point": 2e-5, "sigma_normal": 1e-3}


def exact_patch(surface, point, *, s=0.0, variance=1.0, lifted=0.0):
    """A patch with the exact matrix at the foot of a point, or lifted off the surface; K known to `variance`."""
    T = surface.contact_frame(surface.project(point))
    S = surface.normalised_at(T[:3, 3]).transformed(T).S
    T = T.copy()
    T[:3, 3] -= lifted * T[:3, 2]
    P = variance * np.diag([1e-6, 1e-6, 1e-10, 1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    return LocalPatch(
        T_base_contact=T, S=S, K_covariance=P[6:, 6:] * 4, S_covariance=P, pose_known=True, observed=[1, 1],
        combinations=np.eye(3), t_s=40 * s, travelled_m=s, distance_m=0.02, innovation=1.0,
    )  # fmt: skip


def ball(pose):
    return SurfaceMatrix(np.diag([1.0, 1.0, 1.0, -(RADIUS**2)]) / (2 * RADIUS)).transformed(np.linalg.inv(pose))


def exact_map(truth, seed=3, **changes):
    """Exact patches every 2 mm along a meridian of a sphere somewhere in space."""
    pose = truth.any_pose(seed)
    surface = ball(pose)
    patches = []
    for i, angle in enumerate(np.arange(12) * 2e-3 / RADIUS):
        p = pose[:3, :3] @ (RADIUS * np.array([math.sin(angle), 0.0, math.cos(angle)])) + pose[:3, 3]
        patches.append(exact_patch(surface, p, s=2e-3 * i, **changes))
    return SurfaceMap(patches=tuple(patches), path=[p.point for p in patches], method="exact"), pose


def at(pose, angle, side=0.0, height=0.0):
    """A point over the sphere, and the outward normal there."""
    n = np.array([math.sin(angle), math.sin(side), math.cos(angle)])
    n = pose[:3, :3] @ (n / np.linalg.norm(n))
    return pose[:3, 3] + (RADIUS + height) * n, n


@pytest.mark.parametrize("height", [-2e-3, 0.0, 1e-3, 15e-3])
def test_exact_patches_give_the_exact_closest_point(truth, height):
    surface_map, pose = exact_map(truth)
    for angle, side in ((0.0, 0.0), (0.131, 0.02), (0.3, -0.05)):
        p, n = at(pose, angle, side, height)
        answer = surface_map.closest([p])
        foot, _ = at(pose, angle, side)
        assert answer.patches[0] >= 2
        assert answer.height[0] == pytest.approx(height, abs=2e-8)
        np.testing.assert_allclose(answer.point[0], foot, atol=2e-8)
        np.testing.assert_allclose(answer.normal[0], n, atol=2e-6)


def test_where_no_patch_is_near_there_is_no_answer(truth):
    surface_map, pose = exact_map(truth)
    far = np.array([at(pose, 0.2, 0.09)[0], at(pose, -0.09)[0], pose[:3, 3] - at(pose, 0.2)[1]])
    near = at(pose, 0.2)[0]
    answer = surface_map.closest([far[0], near, *far[1:]])
    np.testing.assert_array_equal(answer.patches > 0, [False, True, False, False])
    for values in answer[:4]:
        np.testing.assert_array_equal(np.isfinite(values).reshape(4, -1).all(axis=1), [False, True, False, False])
    empty = dataclasses.replace(surface_map, patches=())
    assert np.isnan(empty.distance(far)).all()
    assert [len(values) for values in surface_map.distance(np.zeros((0, 3)))] == [0, 0]


def test_a_blend_lies_between_its_patches_and_nearer_to_the_better_known(truth):
    pose = truth.any_pose(1)
    surface = ball(pose)
    low = exact_patch(surface, at(pose, 0.0)[0])
    for variance, share in ((1.0, 0.5), (1 / 9, 0.9), (9.0, 0.1)):
        high = exact_patch(surface, at(pose, 0.04)[0], s=0.1, variance=variance, lifted=1e-4)
        both = SurfaceMap(patches=(low, high), path=[low.point, high.point])
        distance, _ = both.distance([at(pose, 0.02)[0]])
        assert distance[0] == pytest.approx(-share * 1e-4, rel=2e-3)  # a lifted surface is above the point


def test_a_blend_has_no_steps_and_no_kinks(truth):
    """Each patch is lifted by its own 0.1 mm or so: along the path the answer still moves by small steps."""
    surface_map, pose = exact_map(truth)
    lifts = np.random.default_rng(0).normal(0.0, 1e-4, len(surface_map))
    rough = [dataclasses.replace(p, T_base_contact=_lifted(p, h)) for p, h in zip(surface_map, lifts, strict=True)]
    rough_map = dataclasses.replace(surface_map, patches=tuple(rough))
    angles = np.linspace(0.0, 0.4, 4001)
    heights, _ = rough_map.distance([at(pose, a, 0.01)[0] for a in angles])
    assert np.ptp(heights) > 5e-5
    slopes = np.diff(heights) / (RADIUS * np.diff(angles))
    assert np.abs(slopes).max() < 0.3
    assert np.abs(np.diff(slopes)).max() < 0.01  # where a patch enters or leaves, too


def _lifted(patch, height):
    T = patch.T_base_contact.copy()
    T[:3, 3] += height * patch.normal
    return T


def test_sigma_of_the_surface_covers_its_error(truth):
    """The height of fitted patches beside their contacts: errors over σ have the size that is stated."""
    ratios = []
    for seed in range(60):
        path = truth.path("ellipsoid", T=truth.any_pose(5))
        estimate = fit_surface(*path.noisy(2e-5, 1e-3, seed), **SIGMA)
        patch = LocalPatch.of(estimate, t_s=0.0, travelled_m=0.0)
        surface_map = SurfaceMap(patches=(patch,), path=[patch.point])
        beside = path.surface.project(patch.point + 2e-3 * patch.T_base_contact[:3, 0])
        distance, sigma = surface_map.distance([beside])
        ratios.append(distance[0] / sigma[0])
    assert 0.75 < np.std(ratios) < 1.25
    assert abs(np.mean(ratios)) < 0.4


def test_a_patch_that_does_not_know_its_height_says_nothing_about_sigma(truth):
    surface_map, pose = exact_map(truth)
    p = [at(pose, 0.2)[0]]
    distance, sigma = surface_map.distance(p)
    blind = [dataclasses.replace(patch, pose_known=False) for patch in surface_map]
    mixed = dataclasses.replace(surface_map, patches=(*surface_map.patches[:5], *blind[5:]))
    assert mixed.distance(p)[1] == pytest.approx(sigma, rel=0.5)
    alone = dataclasses.replace(surface_map, patches=tuple(blind)).distance(p)
    assert alone[0] == pytest.approx(distance, abs=1e-9)
    assert np.isnan(alone[1]).all()


def test_patches_are_kept_by_path_not_by_time(truth):
    """A contact that stands still for 50 answers adds no patch, and the first of each stretch is kept."""
    surface = ball(truth.any_pose(0))
    along = np.concatenate([np.full(50, 1e-3), 1e-3 + np.arange(60) * 0.4e-3, np.full(30, 24.6e-3)])
    template = exact_patch(surface, at(truth.any_pose(0), 0.0)[0])
    patches = [dataclasses.replace(template, travelled_m=s, t_s=0.04 * i) for i, s in enumerate(along)]
    kept = spaced(patches, 2e-3)
    assert [round(1e3 * p.travelled_m, 3) for p in kept] == [1 + 2 * i for i in range(12)]
    assert kept[0].t_s == 0.0
    assert len(merge_patches(patches, [[0, 0, 0]], spacing=4e-3)) == 6


def test_patches_that_observed_nothing_are_left_out(truth):
    surface_map, _ = exact_map(truth)
    blind = [dataclasses.replace(p, combinations=np.zeros((0, 3)), observed=[0, 0]) for p in surface_map.patches[:4]]
    merged = merge_patches([*blind, *surface_map.patches[4:]], surface_map.path)
    assert [p.rank for p in merged] == [3] * 8


def test_a_patch_says_what_its_estimate_says(truth):
    path = truth.path("saddle", T=truth.any_pose(2))
    estimate = fit_surface(*path.noisy(2e-5, 1e-3, 1), **SIGMA)
    patch = LocalPatch.of(estimate, t_s=1.5, travelled_m=0.02)
    np.testing.assert_array_equal(patch.K_covariance, estimate.covariance)
    np.testing.assert_array_equal(patch.normal, estimate.normal)
    # at the contact K = 2 (c11, c12, c22), but for what tilt and height add: their covariance is of that size
    np.testing.assert_allclose(4 * np.diag(patch.S_covariance)[6:], np.diag(estimate.covariance), rtol=0.05)
    assert 1e-6 < math.sqrt(patch.S_covariance[2, 2]) < 2e-5  # the height: better than one point


@pytest.mark.parametrize("method", ["ml", "recursive"])
def test_what_a_straight_path_leaves_open_is_wide(truth, method):
    path = truth.straight("cylinder", angle=0.3)
    estimate = fit_surface(*path.noisy(2e-5, 1e-3, 1), **SIGMA, method=method)
    patch = LocalPatch.of(estimate, t_s=0.0, travelled_m=0.0)
    assert patch.rank == estimate.rank == 2
    along, across = np.array([math.cos(0.3), math.sin(0.3)]), np.array([-math.sin(0.3), math.cos(0.3)])
    P = patch.T_base_contact[:3, :2].T[:, :2]  # axes of the frame of the path in the contact frame
    sigma = [_sigma_of_curvature(patch, P @ t) for t in (along, across)]
    assert sigma[0] < 2.0
    assert sigma[1] == pytest.approx(UNSEEN_CURVATURE_SIGMA / estimate.distance, rel=0.05)
    # the height on the path beside the contact is known, across it is not
    surface_map = SurfaceMap(patches=(patch,), path=[patch.point])
    beside = [path.surface.project(patch.point + 2e-3 * np.append(t, 0)) for t in (-along, across)]
    _, sigma = surface_map.distance(beside)
    assert sigma[0] < 3e-5
    assert sigma[1] > 5e-4


@pytest.mark.parametrize("method", ["ml", "chord"])
@pytest.mark.parametrize("still", [0.0, 2e-5])
def test_a_contact_that_stands_still_makes_a_patch_that_knows_nothing_of_curvature(method, still):
    """Also with points that are equal: a run never ends in an error for lack of data."""
    points = still * np.random.default_rng(0).normal(size=(50, 3))
    estimate = fit_surface(points, np.tile([0.0, 0.0, -1.0], (50, 1)), **SIGMA, method=method)
    patch = LocalPatch.of(estimate, t_s=0.0, travelled_m=0.0)
    assert patch.rank == 0
    assert len(merge_patches([patch], [patch.point])) == 0
    sigma = np.sqrt(np.diag(patch.S_covariance))
    assert sigma[6:].min() > 100.0
    known = sigma > 0.0
    assert (
        np.linalg.eigvalsh(patch.S_covariance[np.ix_(known, known)] / np.outer(sigma[known], sigma[known])).min() > 0.0
    )


def _sigma_of_curvature(patch, t):
    row = np.zeros(9)
    row[6:] = 2 * t[0] ** 2, 4 * t[0] * t[1], 2 * t[1] ** 2
    return math.sqrt(row @ patch.S_covariance @ row)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"S": np.eye(3)}, r"S: expected shape \(4, 4\), got \(3, 3\)"),
        ({"S_covariance": np.full((9, 9), np.nan)}, "S_covariance: expected finite numbers"),
        ({"combinations": np.eye(2)}, r"combinations: expected shape \(n, 3\)"),
        ({"travelled_m": math.inf}, "travelled_m: expected finite"),
    ],
)
def test_bad_patches_are_refused(truth, changes, message):
    patch = exact_map(truth)[0].patches[0]
    with pytest.raises(UsageError, match=message):
        dataclasses.replace(patch, **changes)


def test_bad_maps_and_queries_are_refused(truth):
    surface_map, _ = exact_map(truth)
    with pytest.raises(UsageError, match=r"patches\[1\].travelled_m: expected at least .* in the order"):
        dataclasses.replace(surface_map, patches=surface_map.patches[::-1])
    with pytest.raises(UsageError, match=r"path: expected shape \(n, 3\)"):
        dataclasses.replace(surface_map, path=np.zeros((4, 2)))
    with pytest.raises(UsageError, match="spacing: expected a number above 0"):
        merge_patches(surface_map.patches, surface_map.path, spacing=0.0)
    with pytest.raises(UsageError, match="reach: expected a number above 0"):
        surface_map.distance([[0, 0, 0]], reach=-1.0)
    with pytest.raises(UsageError, match="points: expected finite"):
        surface_map.distance([[0, 0, math.nan]])
    with pytest.raises(UsageError, match=r"cell: expected at least \S+ m for points so far away, got 1e-09"):
        surface_map.mesh(cell=1e-9)


# Meshes, against a ball in closed form: on the surface, closed, oriented, and read back by another library.


def test_the_mesh_of_a_pass_is_a_band_on_the_ball(truth):
    surface_map, pose = exact_map(truth)
    mesh = surface_map.mesh()
    out = mesh.vertices - pose[:3, 3]
    np.testing.assert_allclose(np.linalg.norm(out, axis=1), RADIUS, atol=2e-8)
    np.testing.assert_allclose(mesh.normals, out / RADIUS, atol=2e-6)
    shape = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    assert shape.is_winding_consistent
    assert shape.body_count == 1
    assert np.einsum("ij,ij->i", shape.face_normals, mesh.normals[mesh.triangles[:, 0]]).min() > 0.99
    assert np.degrees(shape.face_angles.min()) > 10  # no slivers
    # 22 mm of path and what is in reach to every side of it, but for up to two cells at the rim
    least, most = (22e-3 * 2 * r + math.pi * r**2 for r in (REACH_M - 1e-3, REACH_M))
    assert least < shape.area < most
    reach = np.linalg.norm(mesh.vertices[:, None] - surface_map.points, axis=2).min(axis=1)
    assert reach.max() < REACH_M
    distance, sigma = surface_map.distance(mesh.vertices)
    assert np.abs(distance).max() < 1e-9
    np.testing.assert_allclose(mesh.sigma, sigma, rtol=1e-6)


def test_patches_all_over_a_ball_make_a_closed_body(truth):
    pose = truth.any_pose(7)
    surface = ball(pose)
    steps = 0.5 + np.arange(300)  # spread over the sphere by the golden angle
    z, turn = 1 - steps / 150, steps * math.pi * (3 - math.sqrt(5))
    n = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    patches = [exact_patch(surface, p, s=i * 1e-3) for i, p in enumerate(pose[:3, 3] + RADIUS * n)]
    mesh = SurfaceMap(patches=tuple(patches), path=np.zeros((0, 3))).mesh(cell=5e-3, reach=15e-3)
    shape = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    assert shape.is_watertight
    assert shape.euler_number == 2
    assert shape.volume == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=5e-3)


def test_what_is_added_elsewhere_leaves_the_triangles_where_they_were(truth):
    surface_map, _ = exact_map(truth)
    fewer = SurfaceMap(patches=surface_map.patches[:6], path=surface_map.path)
    grown, before = surface_map.mesh(cell=1e-3), fewer.mesh(cell=1e-3)
    untouched = np.linalg.norm(before.vertices - surface_map.points[6], axis=1) > REACH_M + 2e-3
    apart = np.linalg.norm(before.vertices[untouched][:, None] - grown.vertices, axis=2).min(axis=1)
    assert untouched.sum() > 20
    assert apart.max() == 0.0


def test_a_ply_file_is_read_by_another_library(truth, tmp_path):
    surface_map, _ = exact_map(truth)
    mesh = surface_map.mesh(cell=1e-3)
    mesh.save_ply(tmp_path / "map.ply")
    read = trimesh.load(tmp_path / "map.ply", process=False)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-7)
    np.testing.assert_array_equal(read.faces, mesh.triangles)
    np.testing.assert_allclose(read.vertex_normals, mesh.normals, atol=1e-6)
    np.testing.assert_allclose(read.metadata["_ply_raw"]["vertex"]["data"]["sigma"], mesh.sigma, rtol=1e-6)
    with pytest.raises(ResultsError, match=r"none/map.ply: cannot be written: No such file"):
        mesh.save_ply(tmp_path / "none" / "map.ply")


def test_without_a_surface_there_are_no_triangles(tmp_path):
    nothing = SurfaceMap(patches=(), path=np.zeros((0, 3))).mesh()
    assert (nothing.vertices.shape, nothing.triangles.shape, nothing.sigma.shape) == ((0, 3), (0, 3), (0,))
    nothing.save_ply(tmp_path / "nothing.ply")
    assert (tmp_path / "nothing.ply").read_bytes().endswith(b"end_header\n")


def test_any_closest_point_can_be_meshed():
    """A surface that lies on the corners of the lattice, as no scan does."""

    def plane(points):
        foot = points * [1.0, 1.0, 0.0]
        inside = (np.abs(points[:, :2]) < 0.0105).all(axis=1)
        height = np.where(inside, points[:, 2], math.nan)
        return Feet(foot, np.tile([0.0, 0.0, 1.0], (len(points), 1)), height, 0 * height, inside)

    mesh = mesh_of(plane, np.zeros((1, 3)), 1e-3)
    shape = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    assert shape.area == pytest.approx(19e-3**2)
    np.testing.assert_allclose(shape.face_normals[:, 2], 1.0)


def test_a_point_over_the_middle_of_a_pass_is_as_high_as_it_is(truth):
    surface_map, pose = exact_map(truth)
    heights = np.linspace(-2e-3, 2e-3, 9)
    distance, sigma = surface_map.distance([at(pose, 0.2, 0.0, h)[0] for h in heights])
    np.testing.assert_allclose(distance, heights, atol=1e-8)
    assert (sigma > 0).all()
