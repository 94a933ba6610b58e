"""Where two passes cross: p-values that are uniform for one surface, and small for two."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import combine_pvalues, kstest

from canprobe.errors import UsageError
from canprobe.mechanics.touch.consistency import Consistency, check_consistency, find_crossings, fisher
from canprobe.mechanics.touch.crossings import compare
from canprobe.mechanics.touch.estimate.fit import fit_surface
from canprobe.mechanics.touch.surface import SurfaceMatrix
from canprobe.mechanics.touch.surface_map import LocalPatch, SurfaceMap, merge_patches

SIGMA_POINT, SIGMA_NORMAL = 2e-5, 1e-3
PARTS = ("curvature", "normal", "height", "joint")
DOF = {"curvature": 3, "normal": 2, "height": 1, "joint": 6}


def woven(truth, surface, angle, shift=(0.0, 0.0), T=None):
    """A weave over a surface, turned by an angle about the origin and shifted."""
    x, y = truth.weave()
    c, s = math.cos(angle), math.sin(angle)
    return truth.placed(surface, c * x - s * y + shift[0], s * x + c * y + shift[1], T)


def patch(path, seed, s=0.0, method="ml"):
    points, normals = path.noisy(SIGMA_POINT, SIGMA_NORMAL, seed)
    estimate = fit_surface(points, normals, sigma_point=SIGMA_POINT, sigma_normal=SIGMA_NORMAL, method=method)
    return LocalPatch.of(estimate, t_s=40 * s, travelled_m=s)


def crossed(first, second, seeds, method="ml"):
    """Crossings of two passes, each with noise of its own."""
    return [compare(patch(first, 2 * i, 0.0, method), patch(second, 2 * i + 1, 0.1, method)) for i in seeds]


@pytest.mark.parametrize("name", ["cylinder", "ellipsoid"])
def test_p_values_of_one_surface_are_uniform(truth, name):
    """Two passes 1.1 mm apart in different directions, independent noise of the stated size."""
    surface, T = truth.surface(name), truth.any_pose(4)
    found = crossed(woven(truth, surface, 0.3, T=T), woven(truth, surface, 2.0, (1e-3, -0.5e-3), T), range(90))
    for part in PARTS:
        tests = [getattr(crossing, part) for crossing in found]
        assert {test.dof for test in tests} == {DOF[part]}
        assert kstest([test.p for test in tests], "uniform").pvalue > 0.01, part
        mean = np.mean([test.chi2 for test in tests]) / DOF[part]
        assert abs(mean - 1) < 3 * math.sqrt(2 / DOF[part] / len(tests)), part


def test_the_filter_is_on_the_safe_side(truth):
    """Its stated covariances are somewhat above the true ones, p-values above uniform."""
    surface = truth.surface("cylinder")
    found = crossed(woven(truth, surface, 0.3), woven(truth, surface, 2.0, (1e-3, -0.5e-3)), range(14), "recursive")
    chi2_per_dof = np.mean([crossing.joint.chi2 for crossing in found]) / 6
    assert 0.4 < chi2_per_dof < 1.0
    assert np.mean([crossing.joint.p for crossing in found]) > 0.5


TWO_SURFACES = {
    "height": (5e-5, 0.0, 0.0, {"height", "joint"}),
    "normal": (0.0, 3e-3, 0.0, {"normal", "joint"}),
    "curvature": (0.0, 0.0, 6.0, {"curvature", "joint"}),
}


@pytest.mark.parametrize("what", TWO_SURFACES)
def test_a_second_pass_over_another_surface_is_rejected(truth, what):
    """The second pass is lifted, tilted or curved more at the place where both end; only that part rejects."""
    lift, tilt, bend, wanted = TWO_SURFACES[what]
    one = SurfaceMatrix.from_curvature([[27.8, 0.0], [0.0, 5.0]])
    other = SurfaceMatrix.from_curvature([[27.8 + bend, 0.0], [0.0, 5.0]])
    T = np.eye(4)
    T[:3, :3] = [[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0], [-math.sin(tilt), 0, math.cos(tilt)]]
    T[2, 3] = -lift
    found = crossed(woven(truth, one, 0.3), woven(truth, other, 2.0, T=T), range(6))
    median = {part: np.median([getattr(crossing, part).p for crossing in found]) for part in PARTS}
    assert {part for part in PARTS if median[part] < 1e-3} == wanted
    assert min(median[part] for part in set(PARTS) - wanted) > 0.05


def test_the_difference_has_its_sign_and_unit(truth):
    """Exact patches: z is the inward normal, so a lifted second surface differs by less than nothing."""
    one = SurfaceMatrix.from_curvature([[27.8, 4.0], [4.0, -5.0]])
    other = SurfaceMatrix.from_curvature([[29.8, 4.0], [4.0, -8.0]])
    T = truth.any_pose(7)
    tilt = 2e-3
    R = np.array([[1, 0, tilt], [0, 1, 0], [-tilt, 0, 1]])  # z of the second at x is tilt·(−x) in the first's frame
    lifted = np.eye(4)
    lifted[:3, :3], lifted[2, 3] = np.linalg.qr(R)[0] * np.sign(np.diag(np.linalg.qr(R)[1])), -1e-4
    a = _exact(one, T)
    b = _exact(other, T @ lifted)
    crossing = compare(a, b)
    local = T[:3, :3].T @ crossing.T_base_common[:3, :3]  # axes of the comparison in the first's
    Q = local[:2, :2]
    assert crossing.difference[0] == pytest.approx(-1e-4, rel=1e-3)
    np.testing.assert_allclose(Q @ crossing.difference[1:3], [-tilt, 0.0], atol=2e-5)
    d = crossing.difference[3:]
    np.testing.assert_allclose(Q @ [[d[0], d[1]], [d[1], d[2]]] @ Q.T, [[2.0, 0.0], [0.0, -3.0]], atol=2e-2)
    back = compare(b, a)
    np.testing.assert_allclose(back.difference, -crossing.difference, atol=1e-12)
    assert back.joint.chi2 == pytest.approx(crossing.joint.chi2)


def _exact(surface, T, s=0.0, **changes):
    P = np.diag([1e-6, 1e-6, 1e-10, 1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
    made = LocalPatch(
        T_base_contact=T, S=surface.S, K_covariance=4 * P[6:, 6:], S_covariance=P, pose_known=True, observed=[1, 1],
        combinations=np.eye(3), t_s=0.0, travelled_m=s, distance_m=0.02, innovation=1.0,
    )  # fmt: skip
    return dataclasses.replace(made, **changes)


@pytest.mark.parametrize(("angle", "dof"), [(0.0, 2), (0.01, 2), (math.pi / 2, 1), (0.7, 1)])
def test_only_what_both_passes_observed_is_compared(truth, angle, dof):
    """Straight passes see the curvature along them and the twist: alike both, at an angle one combination is left.

    Two planes of observed combinations in a space of three always share a line.
    """
    first, second = (patch(truth.straight("cylinder", 0.4 + a), i) for i, a in enumerate((0.0, angle)))
    assert (first.rank, second.rank) == (2, 2)
    crossing = compare(first, second)
    assert crossing.curvature.dof == dof
    assert crossing.joint.dof == dof + 3
    assert crossing.joint.p > 0.01


def test_what_was_not_observed_cannot_disagree(truth):
    """Two cylinders that differ in radius, both felt along their common axis: nothing that was seen tells."""
    felt = [truth.placed(SurfaceMatrix.cylinder(r), np.zeros(160), np.linspace(-0.02, 0, 160)) for r in (0.036, 0.030)]
    crossing = compare(patch(felt[0], 0), patch(felt[1], 1))
    assert crossing.curvature.dof == 2
    assert crossing.curvature.p > 0.01
    assert crossing.joint.p > 0.01


def test_methods_that_do_not_know_the_pose_compare_curvature_alone(truth):
    surface = truth.surface("cylinder")
    first, second = (patch(woven(truth, surface, a), i, method="chord") for i, a in enumerate((0.3, 2.0)))
    crossing = compare(first, second)
    assert (crossing.curvature.dof, crossing.normal.dof, crossing.height.dof, crossing.joint.dof) == (3, 0, 0, 3)
    assert math.isnan(crossing.height.p)
    np.testing.assert_allclose(
        np.trace(crossing.covariance[3:, 3:]), np.trace(first.K_covariance + second.K_covariance), rtol=0.1
    )


# all crossings of a path


def figure_eight(n=240, spacing=1e-3):
    """A lemniscate over a plane, walked twice: points and path."""
    t = np.linspace(0.0, 4 * np.pi, 20 * n)
    x, y = 0.02 * np.sin(t), 0.012 * np.sin(2 * t)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    at = np.arange(0.0, s[-1], spacing)
    return np.interp(at, s, x), np.interp(at, s, y), at


def flat_map(memory, lift=None):
    x, y, s = figure_eight()
    patches = []
    for i in range(len(s)):
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, 3] = x[i], y[i], 0.0 if lift is None else lift[i]
        patches.append(_exact(SurfaceMatrix.plane(), T, s=s[i], distance_m=memory))
    return SurfaceMap(patches=tuple(patches), path=np.stack([x, y, 0 * x], axis=1))


def test_crossings_are_found_where_the_path_crosses_itself():
    """Each lap of the eight passes its middle twice, at an angle; the second lap lies on the first."""
    _, _, s = figure_eight()
    surface_map = flat_map(0.01)
    found = find_crossings(surface_map)
    middle = [c for c in found if np.linalg.norm(c.T_base_common[:3, 3]) < 1e-3 and 0.5 < c.angle < math.pi - 0.5]
    assert len(middle) == 6  # it is there five times, start and end included: three one way, two the other
    expected = 2 * math.atan2(0.024, 0.02)
    assert all(min(abs(c.angle - expected), abs(math.pi - c.angle - expected)) < 0.15 for c in middle)
    along = [c for c in found if c.angle < 0.1]
    lap = 0.5 * s[-1]
    assert all(min(abs(c.gap_m - lap), abs(c.gap_m - 2 * lap)) < 3e-3 for c in along)  # two: its start and its end
    first = np.sort([surface_map.travelled[c.first] for c in along if abs(c.gap_m - lap) < 3e-3])
    assert np.diff(first).min() > 2e-3  # two of one crossing differ by more than two radii here or there,
    assert np.diff(first).max() < 9e-3  # and the second lap is nowhere out of reach of the first
    assert all(c.gap_m >= 0.03 and c.distance_m <= 2e-3 for c in found)
    assert find_crossings(surface_map, gap=2 * s[-1]) == []
    assert find_crossings(dataclasses.replace(surface_map, patches=())) == []


def test_they_are_those_of_all_pairs_closest_first():
    """By their definition, over a path that wanders about one place."""
    rng = np.random.default_rng(5)
    points = np.cumsum(rng.normal(scale=2e-3, size=(400, 2)), axis=0) % 0.02
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    patches = []
    for (x, y), at in zip(points, s, strict=True):
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:2, 3] = x, y
        patches.append(_exact(SurfaceMatrix.plane(), T, s=at))
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    pairs = [(apart[i, j], i, j) for j in range(400) for i in range(j) if apart[i, j] <= 2e-3 and s[j] - s[i] >= 0.05]
    chosen = []
    for _, i, j in sorted(pairs):
        if all(max(abs(s[i] - s[a]), abs(s[j] - s[b])) > 4e-3 for a, b in chosen):
            chosen.append((i, j))
    found = find_crossings(SurfaceMap(patches=tuple(patches), path=np.zeros((0, 3))), gap=0.05)
    assert len(chosen) > 100
    assert [(c.first, c.second) for c in found] == sorted(chosen)


def test_opposite_sides_of_a_thin_body_do_not_cross():
    above = _exact(SurfaceMatrix.plane(), np.diag([1.0, -1.0, -1.0, 1.0]))
    below = _exact(SurfaceMatrix.plane(), np.eye(4), s=0.5)
    assert find_crossings(SurfaceMap(patches=(above, below), path=np.zeros((0, 3)))) == []


def test_independent_crossings_share_no_data():
    surface_map = flat_map(0.01)
    consistency = check_consistency(surface_map)
    places = [
        surface_map.travelled[i]
        for k in consistency.independent
        for i in (consistency.crossings[k].first, consistency.crossings[k].second)
    ]
    assert len(places) >= 4
    assert np.diff(np.sort(places)).min() >= 0.03 - 1e-12


def test_the_verdict_pools_and_tells_directions_apart():
    """A lag of 60 µm along x, as hysteresis leaves it: passes that run alike agree, others do not."""
    x, _, _ = figure_eight()
    assert check_consistency(flat_map(0.01)).consistent is True
    lagging = check_consistency(flat_map(0.01, lift=6e-5 * np.sign(np.gradient(x))))
    same, other = lagging.verdict("height", (0.0, 0.3)), lagging.verdict("height", (0.5, math.inf))
    assert same.share_below < 0.1
    assert other.share_below > 0.9
    assert same.chi2_per_dof < 1 < other.chi2_per_dof
    assert lagging.verdict("curvature").share_below == 0.0
    assert lagging.verdict().tested == same.tested + other.tested + lagging.verdict("height", (0.3, 0.5)).tested


def test_nothing_to_test_is_no_verdict():
    nothing = Consistency((), ())
    assert nothing.consistent is None
    assert nothing.verdict().tested == 0
    assert math.isnan(nothing.verdict("height").share_below)
    assert check_consistency(merge_patches([], np.zeros((0, 3)))).crossings == ()
    alone = dataclasses.replace(_exact(SurfaceMatrix.plane(), np.eye(4)), distance_m=0.0)
    assert find_crossings(SurfaceMap(patches=(alone,), path=np.zeros((0, 3)))) == []  # not with itself


def test_fisher_is_scipys():
    p = [0.2, 0.013, 0.8, 0.44]
    expected = combine_pvalues(p, "fisher")
    assert fisher(p).chi2 == pytest.approx(expected.statistic)
    assert fisher(p).p == pytest.approx(expected.pvalue)
    assert fisher([0.5]).p == pytest.approx(0.5)
    assert fisher([0.0, 0.5]).p < 1e-100
    assert fisher([]).dof == 0


def test_bad_arguments_are_refused():
    surface_map = flat_map(0.01)
    with pytest.raises(UsageError, match="radius: expected a number above 0, got 0"):
        find_crossings(surface_map, radius=0.0)
    with pytest.raises(UsageError, match="gap: expected a number above 0, got -1"):
        check_consistency(surface_map, gap=-1.0)
    with pytest.raises(UsageError, match="part: expected one of curvature, normal, height, joint, got 'tilt'"):
        Consistency((), ()).verdict("tilt")
