"""The map of local patches: what is kept of a path, and the surface that it answers with."""

import dataclasses
import math

import numpy as np
import pytest

from canprobe.errors import UsageError
from canprobe.touch.estimate.fit import fit_surface
from canprobe.touch.surface import SurfaceMatrix
from canprobe.touch.surface_map import WIDE, LocalPatch, SurfaceMap, closest, merge_patches, spaced

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
        answer = closest(surface_map, p)
        foot, _ = at(pose, angle, side)
        assert answer.patches >= 2
        assert answer.height == pytest.approx(height, abs=2e-8)
        np.testing.assert_allclose(answer.point, foot, atol=2e-8)
        np.testing.assert_allclose(answer.normal, n, atol=2e-6)


def test_where_no_patch_is_near_there_is_no_answer(truth):
    surface_map, pose = exact_map(truth)
    for p in (at(pose, 0.2, 0.09)[0], at(pose, -0.09)[0], pose[:3, 3] - at(pose, 0.2)[1]):
        answer = closest(surface_map, p)
        assert answer.patches == 0
        assert np.isnan([*answer.point, *answer.normal, answer.height, answer.sigma]).all()
    assert closest(dataclasses.replace(surface_map, patches=()), np.zeros(3)).patches == 0


def test_a_blend_lies_between_its_patches_and_nearer_to_the_better_known(truth):
    pose = truth.any_pose(1)
    surface = ball(pose)
    low = exact_patch(surface, at(pose, 0.0)[0])
    for variance, share in ((1.0, 0.5), (1 / 9, 0.9), (9.0, 0.1)):
        high = exact_patch(surface, at(pose, 0.04)[0], s=0.1, variance=variance, lifted=1e-4)
        both = SurfaceMap(patches=(low, high), path=[low.point, high.point])
        answer = closest(both, at(pose, 0.02)[0])
        assert answer.height == pytest.approx(-share * 1e-4, rel=2e-3)  # a lifted surface is above the point
        assert answer.patches == 2


def test_a_blend_has_no_steps(truth):
    """Each patch is lifted by its own 0.1 mm or so: along the path the answer still moves by small steps."""
    surface_map, pose = exact_map(truth)
    lifts = np.random.default_rng(0).normal(0.0, 1e-4, len(surface_map))
    rough = [dataclasses.replace(p, T_base_contact=_lifted(p, h)) for p, h in zip(surface_map, lifts, strict=True)]
    rough_map = dataclasses.replace(surface_map, patches=tuple(rough))
    angles = np.linspace(0.0, 0.4, 401)
    heights = np.array([closest(rough_map, at(pose, a, 0.01)[0]).height for a in angles])
    assert np.ptp(heights) > 5e-5
    assert np.abs(np.diff(heights)).max() < 6e-6


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
        answer = closest(surface_map, beside)
        ratios.append(answer.height / answer.sigma)
    assert 0.75 < np.std(ratios) < 1.25
    assert abs(np.mean(ratios)) < 0.4


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
    assert sigma[1] == pytest.approx(WIDE / estimate.distance, rel=0.05)
    # the height on the path beside the contact is known, across it is not
    surface_map = SurfaceMap(patches=(patch,), path=[patch.point])
    beside = [
        closest(surface_map, path.surface.project(patch.point + 2e-3 * np.append(t, 0))) for t in (-along, across)
    ]
    assert beside[0].sigma < 3e-5
    assert beside[1].sigma > 5e-4


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
        closest(surface_map, [0, 0, 0], reach=-1.0)
    with pytest.raises(UsageError, match="point: expected finite"):
        closest(surface_map, [0, 0, math.nan])
