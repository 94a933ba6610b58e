"""fit_surface and cramer_rao: exact without noise, at the bound with it, honest where nothing was observed."""

from __future__ import annotations

import math

import numpy as np
import pytest

from canprobe.errors import UsageError
from canprobe.mechanics.touch import (
    Correlation,
    Prior,
    SurfaceEstimate,
    SurfaceMatrix,
    cramer_rao,
    fit_surface,
    make_estimator,
)

TINY = {"sigma_point": 1e-9, "sigma_normal": 1e-9}
WEIGHT = np.array([1.0, 2.0, 1.0])
"""K12 stands twice in the Frobenius norm."""


def frobenius(error):
    return math.sqrt(float(WEIGHT @ np.square(error)))


@pytest.mark.parametrize(
    ("method", "name"),
    [("chord", "sphere"), ("chen1996", "cylinder"), *(("ml", name) for name in ("plane", "saddle", "hyperboloid"))],
)
def test_without_noise_it_is_exact(method, name, truth):
    """Maximum likelihood on any quadric, differences where the gradient is constant."""
    path = truth.path(name, T=truth.any_pose(4))
    estimate = fit_surface(path.points, path.normals, method=method, **TINY)
    assert frobenius(path.error(estimate)) < 1e-6
    assert estimate.observed.all()
    assert np.allclose(estimate.T_frame_contact[:3, 3], path.points[-1], atol=1e-12)
    assert np.allclose(estimate.normal, path.normals[-1], atol=1e-9)
    if method == "ml":
        S = path.surface.normalised_at(path.points[-1]).transformed(estimate.T_frame_contact).S
        assert np.allclose(estimate.S, S, atol=1e-4)


RUNS = {"ml": (40, 1.25, 7), "recursive": (16, 1.4, 3)}
"""Runs of a method, its largest RMS error against the bound, and runs that a 95 % region may miss."""


@pytest.mark.parametrize(
    ("name", "method"),
    [("ellipsoid", "ml"), ("small sphere", "ml"), ("ellipsoid", "recursive"), ("cylinder", "recursive")],
)
def test_it_reaches_the_bound_and_covers(name, method, truth):
    """On a ball of 5 mm the noise of the points is felt in the normals: κ σ_p is 4 mrad against 1 mrad of σ_n."""
    path, (seeds, largest, missed) = truth.path(name), RUNS[method]
    noise = {"sigma_point": 2e-5, "sigma_normal": 1e-3}
    bound = math.sqrt(float(WEIGHT @ np.diag(cramer_rao(path.points, path.normals, path.surface, **noise))))
    errors, inside, innovation = [], 0, []
    for seed in range(seeds):
        points, normals = path.noisy(*noise.values(), seed)
        if method == "ml":
            estimate = fit_surface(points, normals, **noise)
        else:
            estimator = make_estimator(method, **noise)
            for sample in truth.samples(points, normals):
                estimator.add(sample)
            estimate = estimator.estimate()
        assert estimate.observed.all()
        error = path.error(estimate)
        errors.append(error)
        innovation.append(estimate.innovation)
        inside += error @ np.linalg.solve(estimate.covariance, error) < 7.815
    rms = math.sqrt(np.mean([frobenius(e) ** 2 for e in errors]))
    assert 0.55 * bound < rms < largest * bound
    assert inside >= seeds - missed
    if method == "ml":
        assert frobenius(np.mean(errors, axis=0)) < 0.5 * bound  # 40 runs leave 0.16 by chance
        assert np.mean(innovation) == pytest.approx(1.0, abs=0.06)
        K = path.surface.curvature_at(path.points[-1])[0]
        assert bound < 0.05 * np.linalg.norm(K)


@pytest.mark.parametrize("method", ["chord", "chen1996"])
@pytest.mark.parametrize(("count", "rank"), [(3, 2), (4, 3), (40, 3)])
def test_differences_of_three_points_leave_one_combination_open(count, rank, method):
    """S y is known of two y: S may have any multiple of m mᵀ more, m across both; on a curve m is not the normal."""
    surface = SurfaceMatrix.sphere(0.05)
    x, y = np.random.default_rng(0).uniform(-0.01, 0.01, size=(2, count))
    points = np.stack([x, y, surface.height(x, y)], axis=1)
    e = fit_surface(points, surface.normal(points), sigma_point=1e-6, sigma_normal=1e-5, method=method, lag=1)
    assert e.rank == rank
    assert e.observed.tolist() == [True, rank == 3]
    if rank == 3:
        assert e.kappa == pytest.approx([20.0, 20.0], rel=1e-6)
        return
    first, second = (points[-1] - points[:-1]) @ e.T_frame_contact[:3, :3]
    m = np.cross(first, second)
    hidden = m[[0, 0, 1]] * m[[0, 1, 1]] * [1.0, math.sqrt(2.0), 1.0]
    assert np.allclose(e.combinations @ hidden, 0.0, atol=1e-9 * np.linalg.norm(hidden))
    assert np.isnan(e.kappa[1])


class TestUnobserved:
    @pytest.mark.parametrize(("name", "angle"), [("cylinder", 0.0), ("cylinder", 0.5 * math.pi), ("sphere", 0.6)])
    def test_a_straight_path_leaves_one_combination_open(self, name, angle, truth):
        path, noise = truth.straight(name, angle), (5e-5, 3e-3)
        K = path.surface.curvature_at([0, 0, 0])[0]
        t = np.array([math.cos(angle), math.sin(angle)])
        for seed in range(5):
            e = fit_surface(*path.noisy(*noise, seed), sigma_point=noise[0], sigma_normal=noise[1])
            assert e.rank == 2
            assert e.observed.tolist() == [True, False]
            assert e.kappa[0] == pytest.approx(t @ K @ t, abs=2.0)
            assert abs(e.directions[0, :2] @ t) > 0.999
            assert np.isnan(e.kappa[1])
            assert np.isnan(e.K[1, 1]) or angle == 0.5 * math.pi
            assert np.isinf(np.diag(e.covariance)).any()
            assert np.isfinite(e.S).all()

    def test_a_prior_on_curvature_fills_in_but_is_named_and_not_called_observed(self, truth):
        path = truth.straight("cylinder")
        p, n = path.noisy(5e-5, 3e-3, 0)
        prior = Prior.flat(0.02, 30.0)
        e = fit_surface(p, n, sigma_point=5e-5, sigma_normal=3e-3, prior=prior)
        assert np.isfinite(e.K).all()
        assert e.prior == prior.name
        assert e.observed.tolist() == [True, False]
        assert math.sqrt(e.covariance[1, 1]) < 1.0
        assert math.sqrt(e.covariance[2, 2]) == pytest.approx(30.0, rel=0.2)

    def test_the_bound_of_a_straight_path_is_infinite_across(self, truth):
        path = truth.straight("cylinder")
        C = cramer_rao(path.points, path.normals, path.surface, sigma_point=2e-5, sigma_normal=1e-3)
        assert np.isfinite(C[:2, :2]).all()
        assert np.isinf(C[2, 2])


def lines_over_a_patch(lines, size, dwell=0):
    """x, y of lines there and back over a patch of a size (m), 1/80 of the size a sample, with a stop on the way."""
    t = np.linspace(0.0, 1.0, 20_001)
    x, y = np.abs(lines * t % 2.0 - 1.0) - 0.5, t - 0.5
    s = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    at = np.sort(np.concatenate([np.arange(0.0, s[-1], 1 / 80), np.full(dwell, 0.6 * s[-1])]))
    return size * np.interp(at, s, x), size * np.interp(at, s, y)


@pytest.mark.parametrize(
    ("radius", "K", "lines", "dwell"),
    [(5e-3, [[1, 0], [0, 1]], 20, 0), (0.05, [[1, 0], [0, 0]], 4, 1000), (10.0, [[1, 0], [0, -0.5]], 20, 0)],
)
def test_recursive_on_a_long_path_over_a_small_patch(radius, K, lines, dwell, truth):
    """Up to 20 times the patch's size of path: its memory goes by the patch and by the surface's radius."""
    size = min(0.4 * radius, 0.02)
    surface = SurfaceMatrix.from_curvature(np.array(K) / radius)
    path = truth.placed(surface, *lines_over_a_patch(lines, size, dwell))
    noise = {"sigma_point": size / 600, "sigma_normal": 1e-3}
    for seed in range(2):
        e = fit_surface(*path.noisy(*noise.values(), seed), **noise, method="recursive")
        error = path.error(e)
        assert e.rank == 3
        assert error @ np.linalg.solve(e.covariance, error) < 16.27  # 99.9 %
        assert frobenius(error) * size < 0.02
        assert e.distance <= 3.0 * size


def test_recursive_refuses_only_what_does_not_move(truth):
    rest = truth.placed(truth.surface("cylinder"), np.zeros(400), np.zeros(400))
    with pytest.raises(UsageError, match="beyond its noise"):
        fit_surface(*rest.noisy(2e-5, 1e-3, 0), sigma_point=2e-5, sigma_normal=1e-3, method="recursive")


def test_noise_per_sample_and_as_covariance(truth):
    path = truth.path("saddle")
    p, n = path.noisy(2e-5, 1e-3, 4)
    fits = [
        fit_surface(p, n, sigma_point=sp, sigma_normal=sn)
        for sp, sn in (
            (2e-5, 1e-3),
            (np.full(160, 2e-5), np.full(160, 1e-3)),
            (4e-10 * np.eye(3), 1e-6 * np.eye(3)),
            (np.tile(4e-10 * np.eye(3), (160, 1, 1)), 1e-3),
        )
    ]
    for other in fits[1:]:
        assert np.allclose(other.K, fits[0].K, atol=1e-4)
        assert np.allclose(other.covariance, fits[0].covariance, rtol=1e-3)
    bad = np.where(np.arange(160) < 40, 1e-3, 2e-5)
    p[:40] += np.random.default_rng(0).normal(size=(40, 3)) * 1e-3
    weighted = fit_surface(p, n, sigma_point=bad, sigma_normal=1e-3)
    assert frobenius(path.error(weighted)) < 2.0


def test_prediction_follows_the_surface(truth):
    path = truth.path("ellipsoid", T=truth.any_pose(7))
    e = fit_surface(path.points, path.normals, **TINY)
    point, normal = e.predict(path.points[-1] + 2e-3 * e.directions[0] + 1e-3 * e.normal)
    assert abs(path.surface.value(point)) < 1e-9 * np.linalg.norm(path.surface.gradient(point))
    assert np.allclose(normal, path.surface.normal(point), atol=1e-8)


def test_the_bound_against_numerical_information():
    """One unknown at a time cannot be checked in closed form, a plane can: slopes of normals over places."""
    rng = np.random.default_rng(0)
    p = np.zeros((50, 3))
    p[:, :2] = rng.uniform(-0.01, 0.01, size=(50, 2))
    p[-1] = 0
    n = np.tile([0.0, 0.0, -1.0], (50, 1))
    C = cramer_rao(p, n, SurfaceMatrix.plane(), sigma_point=1e3, sigma_normal=1e-3)
    x = p[:, :2] - p[:, :2].mean(axis=0)
    xx, xy, yy = x[:, 0] @ x[:, 0], x[:, 0] @ x[:, 1], x[:, 1] @ x[:, 1]
    information = np.array([[xx, xy, 0], [xy, xx + yy, xy], [0, xy, yy]]) / 1e-6
    assert np.allclose(C, np.linalg.inv(information), rtol=1e-6)


@pytest.mark.parametrize(("index", "off"), [(0, 3e-4), (-1, 50.0)])
def test_the_bound_refuses_points_off_the_surface(index, off, truth):
    path = truth.path("ellipsoid")
    noise = {"sigma_point": 2e-5, "sigma_normal": 1e-3}
    assert np.isfinite(cramer_rao(*path.noisy(2e-5, 1e-3, 0), path.surface, **noise)).all()
    points = path.points.copy()
    points[index] += off * path.normals[index]
    with pytest.raises(UsageError, match=rf"^points: expected all on S, .*at index {index % 160};"):
        cramer_rao(points, path.normals, path.surface, **noise)
    with pytest.raises(UsageError, match=r"^points: expected all on S"):
        cramer_rao(1e3 * path.points, path.normals, path.surface, **noise)


def bad(points=None, normals=None, **kw):
    p = np.zeros((5, 3)) if points is None else points
    n = np.tile([0.0, 0.0, 1.0], (len(p), 1)) if normals is None else normals
    return lambda: fit_surface(p, n, **{"sigma_point": 1e-5, "sigma_normal": 1e-3, **kw})


def online(method="recursive", **kw):
    return lambda: make_estimator(method, **{"sigma_point": 1e-5, "sigma_normal": 1e-3, **kw})


UP = [0.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (bad(points=np.zeros((5, 2))), "points: expected"),
        (bad(points=np.full((5, 3), np.nan)), "points: expected"),
        (bad(points=[["a", "b", "c"]] * 3), "points: expected"),
        (bad(points=np.full((5, 3), "1")), "points: expected"),
        (bad(points=[[0, 0, 10**400]] * 5), "points: expected"),
        (bad(points=np.ma.masked_equal(np.eye(5, 3), 1.0)), "points: expected"),
        (bad(points=np.zeros((1, 3))), "points: expected"),
        (bad(normals=np.ones((5, 3))), "normals: expected"),
        (bad(normals=np.tile([0.0, 0.0, 1.000002], (5, 1))), r"normals: expected .*got length 1\.000002"),
        (bad(normals=np.tile(UP, (4, 1))), "normals: expected"),
        (bad(normals=np.vstack([np.tile(UP, (4, 1)), [[0.0, 0.0, -1.0]]])), "normals: expected"),
        (bad(sigma_point=0.0), "sigma_point: expected"),
        (bad(sigma_point=np.inf), "sigma_point: expected"),
        (bad(sigma_point=np.diag([1e-10, 1e-10, 0.0])), "sigma_point: expected"),
        (bad(sigma_point="fine"), "sigma_point: expected"),
        (bad(sigma_normal=-1e-3), "sigma_normal: expected"),
        (bad(sigma_normal=np.ones(4)), "sigma_normal: expected"),
        (bad(coupling=np.nan), "coupling: expected"),
        (bad(method="chen96"), "method: expected .*did you mean chen1996"),
        (bad(method="chen1996", lag=0), "lag: expected"),
        (bad(method="chen1996", lag=2.5), "lag: expected"),
        (bad(method="chord", correlation=Correlation(1e-3)), "correlation: expected none for 'chord'"),
        (bad(correlation=0.002), "correlation: expected"),
        (bad(prior="flat"), "prior: expected"),
        (bad(method="recursive", prior=0.1), "prior: expected"),
        (online("kalman"), "method: expected"),
        (online(sigma_point=0.0), "sigma_point: expected"),
        (online(sigma_normal=math.nan), "sigma_normal: expected"),
        (online(memory_m=0.0), "memory_m: expected"),
        (online(prior=Prior.flat(0.02, 30.0)), "prior: expected"),
        (online("ml", window=1), "window: expected"),
        (online("chen1996", lag=0), "lag: expected"),
        (lambda: Correlation(0.0), r"correlation\.length: expected"),
        (lambda: Correlation(2e-3, 1.5), r"correlation\.share: expected"),
        (lambda: Correlation(2e-3, -0.1), r"correlation\.share: expected"),
        (lambda: Correlation(2e-3, 0.5, "all"), r"correlation\.point_share: expected"),
        (lambda: Correlation(2e-3, pad_length=0.0), r"correlation\.pad_length: expected a number above 0"),
        (lambda: Prior("x", 0.0, 1.0, 1.0), r"prior\.sigma_c13: expected"),
        (lambda: Prior.weak("20 mm"), "length: expected"),
        (lambda: SurfaceEstimate.of(np.eye(4), "K"), "K: expected"),
        (lambda: cramer_rao(np.zeros((5, 3)), [UP] * 5, "S", sigma_point=1, sigma_normal=1), "S: expected"),
    ],
)
def test_errors_name_the_field(call, said):
    with pytest.raises(UsageError, match=f"^{said}"):
        call()


@pytest.mark.parametrize("rows", [1, 4])
def test_the_bound_of_one_place_is_infinite(rows):
    place, S = np.tile([0.0, 0.0, 0.05], (rows, 1)), np.diag([1, 1, 1, -(0.05**2)])
    C = cramer_rao(place, np.tile(UP, (rows, 1)), S, sigma_point=2e-5, sigma_normal=1e-3)
    assert np.isposinf(np.diag(C)).all()
    assert np.isnan(C[~np.eye(3, dtype=bool)]).all()


def test_deviations_that_no_arithmetic_can_bear_are_told():
    a = np.linspace(-0.2, 0.0, 60)
    normals = np.stack([np.sin(a), 0.3 * np.sin(20 * a), -np.cos(a)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    with pytest.raises(UsageError, match="expected those of real noise, got 1e-05 and 1e-30"):
        fit_surface(0.05 * normals, normals, sigma_point=1e-5, sigma_normal=1e-30)
