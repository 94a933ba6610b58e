"""Online estimators: the filter against the batch, what they drop, and standing still."""

from __future__ import annotations

import math

import numpy as np
import pytest

from canprobe.errors import UsageError
from canprobe.mechanics.touch import ContactSample, Prior, cramer_rao, make_estimator
from canprobe.mechanics.touch.estimate import quadric, residuals
from canprobe.mechanics.touch.estimate.fit import METHODS
from canprobe.mechanics.touch.estimate.noise import make_noise
from canprobe.mechanics.touch.estimate.path_length import PathLength, Spread

NOISE = {"sigma_point": 2e-5, "sigma_normal": 1e-3}
WEIGHT = np.array([1.0, 2.0, 1.0])


def make(method="recursive", **kw):
    return make_estimator(method, **{**NOISE, **kw})


def fed(estimator, samples):
    for sample in samples:
        estimator.add(sample)
    return estimator.estimate()


def orbit(truth, name, n, seed=0, noise=(2e-5, 1e-3)):
    """n samples on a figure of ±5 mm that fills both directions; truth is the surface at its last point."""
    s = np.arange(n) * 0.125e-3
    path = truth.placed(truth.surface(name), 5e-3 * np.sin(s / 5e-3), 4e-3 * np.sin(s / 3.1e-3))
    return path, *path.noisy(*noise, seed)


@pytest.mark.parametrize(("sigma_point", "sigma_normal"), [(2e-5, 1e-3), (5e-5, 3e-3)])
@pytest.mark.parametrize("name", ["plane", "cylinder", "sphere", "ellipsoid", "saddle"])
def test_the_filter_is_close_to_the_bound(name, sigma_point, sigma_normal, truth):
    path = truth.path(name)
    noise = {"sigma_point": sigma_point, "sigma_normal": sigma_normal}
    bound = math.sqrt(float(WEIGHT @ np.diag(cramer_rao(path.points, path.normals, path.surface, **noise))))
    errors, inside = [], 0
    for seed in range(16):
        e = fed(make(**noise), truth.samples(*path.noisy(sigma_point, sigma_normal, seed)))
        assert e.observed.all()
        error = path.error(e)
        errors.append(WEIGHT @ error**2)
        inside += error @ np.linalg.solve(e.covariance, error) < 7.815
    assert math.sqrt(np.mean(errors)) < 1.4 * bound
    assert inside >= 13


@pytest.mark.parametrize("method", METHODS)
def test_every_method_finds_a_cylinder(method, truth):
    path = truth.path("cylinder", T=truth.any_pose(3))
    e = fed(make(method), truth.samples(*path.noisy(2e-5, 1e-3, 0)))
    assert e.method == method
    assert e.kappa == pytest.approx([1 / 0.036, 0.0], abs=2.5)
    assert np.allclose(e.S, e.S.T)
    assert e.S[2, 3] == -0.5
    assert np.allclose(e.S[[0, 1, 3], 3], 0.0, atol=1e-12)
    assert np.allclose(e.T_base_contact[:3, 2], -path.normals[-1], atol=0.02)
    assert np.allclose(e.curvature_tensor_base() @ e.directions[0], e.kappa[0] * e.directions[0], atol=1e-9)
    assert e.distance <= 0.03
    assert e.condition_number > 1


def test_rows_are_the_derivative_of_residuals(truth):
    path = truth.path("ellipsoid")
    S = path.surface.S.copy()
    S[:3, :3] *= 0.02
    c = quadric.parameters_of(S)
    d = residuals.design(path.points / 0.02, path.normals, make_noise(160, 1e-9, 1.0))
    J, h = residuals.linearise(c, d).jacobian(), 1e-6
    numeric = [(residuals.linearise(c + h * e, d).r - residuals.linearise(c - h * e, d).r) / (2 * h) for e in np.eye(9)]
    assert np.allclose(J[:, 1:], np.moveaxis(numeric, 0, 2)[:, 1:], atol=1e-8)
    assert np.allclose(J[:, 0] * 1e-9, np.moveaxis(numeric, 0, 2)[:, 0] * 1e-9, atol=1e-8)


def test_transport_is_the_congruence_and_its_derivative():
    rng = np.random.default_rng(2)
    c = 0.3 * rng.normal(size=9)
    T = np.eye(4)
    T[:3, :3], _ = np.linalg.qr(np.eye(3) + 0.1 * rng.normal(size=(3, 3)))
    T[:3, :3] *= np.sign(np.diag(T[:3, :3]))
    T[:3, 3] = 0.1 * rng.normal(size=3)
    new, M = residuals.transport(c, T)
    S = T.T @ quadric.matrix_of(c) @ T
    assert np.allclose(quadric.matrix_of(new), S * (-0.5 / S[2, 3]))
    h = 1e-6
    numeric = [
        (residuals.transport(c + h * e, T)[0] - residuals.transport(c - h * e, T)[0]) / (2 * h) for e in np.eye(9)
    ]
    assert np.allclose(M, np.transpose(numeric), atol=1e-8)


def test_the_filter_settles_after_a_change_of_curvature(truth):
    """A plane runs into a cylinder of 20 mm: within 5 % after 5 mm of it."""
    r, u = 0.02, np.arange(-0.03, 0.013, 0.08e-3)
    y = 2.5e-3 * np.sin(2 * np.pi * u / 0.012)
    a = np.maximum(u, 0) / r
    p = np.stack([np.where(u < 0, u, r * np.sin(a)), y, r * (1 - np.cos(a))], axis=1)
    n = np.stack([np.sin(a), 0 * a, -np.cos(a)], axis=1)
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    arc -= np.interp(0.0, u, arc)
    rng = np.random.default_rng(0)
    estimator = make()
    for i, (point, normal) in enumerate(zip(p, n, strict=True)):
        noisy = normal + 1e-3 * rng.normal(size=3)
        [sample] = truth.samples([point + 2e-5 * rng.normal(size=3)], [noisy / np.linalg.norm(noisy)], 0.005 * i)
        estimator.add(sample)
        e = estimator.estimate()
        if arc[i] < -1e-3 and arc[i] > -0.02:
            assert abs(e.kappa[0]) < 1.0
        if arc[i] > 8e-3:
            assert e.kappa[0] == pytest.approx(50.0, rel=0.05)
    assert any("changed" in note for note in e.notes)


class TestStandingStill:
    def test_it_adds_nothing_and_forgets_nothing(self, truth):
        path, p, n = orbit(truth, "ellipsoid", 400)
        estimator = make()
        before = fed(estimator, truth.samples(p, n))
        rng = np.random.default_rng(5)
        here, normal = path.points[-1], path.normals[-1]
        still = here + 2e-5 * rng.normal(size=(6000, 3))
        nn = normal + 1e-3 * rng.normal(size=(6000, 3))
        nn /= np.linalg.norm(nn, axis=1, keepdims=True)
        T = np.eye(4)
        for i in range(6000):
            estimator.add(ContactSample(10 + 0.005 * i, still[i], nn[i], T, here, 1.0))
        after = estimator.estimate()
        change = np.linalg.norm(after.covariance - before.covariance)
        assert change < 0.1 * np.linalg.norm(before.covariance)
        assert np.allclose(after.kappa, before.kappa, atol=0.3)
        assert after.observed.all()

    def test_from_the_start_nothing_is_known(self, truth):
        path = truth.placed(truth.surface("cylinder"), np.zeros(2000), np.zeros(2000))
        e = fed(make(), truth.samples(*path.noisy(2e-5, 1e-3, 0)))
        assert e is None or not e.observed.any()

    def test_slow_motion_is_not_believed_more_than_its_path_allows(self, truth):
        def sigma(step):
            s = np.arange(0, 0.02, step)
            path = truth.placed(truth.surface("cylinder"), 5e-3 * np.sin(s / 5e-3), 4e-3 * np.sin(s / 3.1e-3))
            return math.sqrt(fed(make(), truth.samples(*path.noisy(2e-5, 1e-3, 0))).covariance[0, 0])

        usual, slow = sigma(0.125e-3), sigma(0.004e-3)
        assert 0.6 * usual < slow  # 31 times the samples


@pytest.mark.parametrize("angle", [0.0, 0.5 * math.pi, 0.6])
def test_a_straight_path_is_flagged_online(angle, truth):
    path = truth.straight("cylinder", angle)
    e = fed(make(), truth.samples(*path.noisy(2e-5, 1e-3, 1)))
    assert e.observed.tolist() == [True, False]
    assert e.kappa[0] == pytest.approx(math.cos(angle) ** 2 / 0.036, abs=1.5)
    assert np.isnan(e.kappa[1])
    assert np.isfinite(e.curvature_tensor_base()).all()


def test_many_updates_stay_definite_and_right(truth):
    path, p, n = orbit(truth, "ellipsoid", 6000)
    estimator = make()
    for i, sample in enumerate(truth.samples(p, n)):
        estimator.add(sample)
        if i % 1000 == 999:
            e = estimator.estimate()
            assert (np.linalg.eigvalsh(e.covariance) > 0).all()
            assert np.array_equal(e.S, e.S.T)
            K, B = path.surface.curvature_at(path.points[i])
            P = e.T_frame_contact[:3, :2]
            assert np.linalg.norm(e.K - P.T @ B @ K @ B.T @ P) < 2.0
    assert estimator.dropped.total == 0


@pytest.mark.parametrize("method", ["recursive", "ml"])
def test_outliers_have_bounded_influence(method, truth):
    path = truth.path("cylinder")
    p, n = path.noisy(2e-5, 1e-3, 5)
    rng = np.random.default_rng(6)
    wrong = rng.choice(np.arange(30, 150), 8, replace=False)
    p[wrong] += rng.normal(size=(8, 3)) * 1e-3
    e = fed(make(method), truth.samples(p, n))
    assert math.sqrt(WEIGHT @ path.error(e) ** 2) < 3.0


@pytest.mark.parametrize("method", METHODS)
def test_bad_samples_are_dropped_and_counted(method, truth):
    path = truth.path("sphere")
    p, n = path.noisy(2e-5, 1e-3, 0)
    good = list(truth.samples(p, n))
    clean = fed(make(method), good)
    estimator = make(method)
    for i, s in enumerate(good):
        estimator.add(s)
        if i == 50:
            for bad in (
                ContactSample(s.t_s + 1e-3, s.p_base * np.nan, s.n_base, s.T_base_probe, s.r_probe, 1.0),
                ContactSample(math.inf, s.p_base, s.n_base, s.T_base_probe, s.r_probe, 1.0),
                ContactSample(s.t_s, s.p_base, s.n_base, s.T_base_probe, s.r_probe, 1.0),
                ContactSample(s.t_s - 1.0, s.p_base, s.n_base, s.T_base_probe, s.r_probe, 1.0),
                ContactSample(s.t_s + 1e-3, s.p_base, s.n_base, s.T_base_probe, s.r_probe, 1.0, sigma_point=0.0),
                ContactSample(s.t_s + 1e-3, s.p_base, 2 * s.n_base, s.T_base_probe, s.r_probe, 1.0),
            ):
                estimator.add(bad)
    d = estimator.dropped
    assert (d.not_finite, d.repeated, d.backwards, d.zero_sigma, d.not_unit) == (2, 1, 1, 1, 1)
    assert d.total == 6
    assert np.array_equal(estimator.estimate().K, clean.K)


@pytest.mark.parametrize("method", METHODS)
def test_reset_forgets(method, truth):
    path = truth.path("sphere")
    fresh = fed(make(method), truth.samples(path.points, path.normals))
    estimator = make(method)
    other = truth.path("saddle")
    fed(estimator, truth.samples(other.points, other.normals))
    estimator.reset()
    assert estimator.estimate() is None
    again = fed(estimator, truth.samples(path.points, path.normals))
    assert np.array_equal(again.K, fresh.K)


@pytest.mark.parametrize(
    ("kw", "field"),
    [
        ({"method": "kalman"}, "method"),
        ({"sigma_point": 0.0}, "sigma_point"),
        ({"sigma_normal": math.nan}, "sigma_normal"),
        ({"memory_m": 0.0}, "memory_m"),
        ({"prior": Prior.flat(0.02, 30.0)}, "prior"),
        ({"method": "ml", "window": 1}, "window"),
        ({"method": "chen1996", "lag": 0}, "lag"),
    ],
)
def test_settings_are_checked(kw, field):
    with pytest.raises(UsageError, match=f"^{field}: expected"):
        make(**kw)


class TestTravel:
    def test_noise_is_no_path(self):
        rng = np.random.default_rng(0)
        travel = PathLength(3 * 5e-5)
        assert sum(travel.add(x) for x in 5e-5 * rng.normal(size=(50000, 3))) == 0.0

    def test_motion_is(self):
        rng = np.random.default_rng(0)
        travel = PathLength(0.5e-3)
        x = np.outer(np.arange(800) * 0.125e-3, [0.6, 0.8, 0.0])
        got = sum(travel.add(p) for p in x + 5e-5 * rng.normal(size=x.shape))
        assert got == pytest.approx(0.1, rel=0.05)
        assert travel.total == pytest.approx(got, rel=1e-12)

    def test_spread_is_the_weighted_covariance(self):
        rng = np.random.default_rng(1)
        x = 5.0 + rng.normal(size=(60, 3))
        spread = Spread()
        for k in range(6):
            spread.fade(0.8)
            spread.add(x[10 * k : 10 * k + 10], np.full(10, 0.5))
        w = 0.5 * np.repeat(0.8 ** np.arange(5, -1, -1), 10)
        assert spread.weight == pytest.approx(w.sum())
        assert np.allclose(spread.covariance, np.cov(x.T, aweights=w, ddof=0))
