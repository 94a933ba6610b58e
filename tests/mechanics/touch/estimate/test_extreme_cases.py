"""Extreme cases of shape, motion, size and data: what every estimator must do there."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter

import numpy as np
import pytest

from canprobe.errors import UsageError
from canprobe.mechanics.touch import ContactSample, Doubt, SurfaceMatrix, cramer_rao, fit_surface, make_estimator
from canprobe.mechanics.touch.estimate.fit import METHODS

SIGMA = (2e-5, 1e-3)
WEIGHT = np.array([1.0, 2.0, 1.0])
MUST = ("ml", "recursive")
"""The others are baselines: they never crash and never call a NaN observed, and are otherwise as they are."""


def make(method, sigma=SIGMA, **kw):
    return make_estimator(method, sigma_point=sigma[0], sigma_normal=sigma[1], **kw)


def fed(estimator, samples):
    for sample in samples:
        estimator.add(sample)
    return estimator.estimate()


def frobenius(error):
    return math.sqrt(float(WEIGHT @ np.square(error)))


def assert_sane(e):
    """No false confidence of any kind: what is observed is finite, what is not is NaN and infinite."""
    assert np.array_equal(np.isfinite(e.kappa), e.observed)
    assert np.isfinite(e.S).all()
    assert np.array_equal(e.S, e.S.T)
    assert e.S[2, 3] == -0.5
    assert np.allclose(e.S[[0, 1, 3], 3], 0.0, atol=1e-12)
    assert np.isfinite(e.T_frame_contact).all()
    known = np.isfinite(np.diag(e.covariance))
    assert np.array_equal(known, np.isfinite([e.K[0, 0], e.K[0, 1], e.K[1, 1]]))
    assert known.all() or e.rank < 3
    if e.rank == 3:
        assert (np.linalg.eigvalsh(e.covariance) > 0).all()


@pytest.mark.parametrize("method", MUST)
@pytest.mark.parametrize(("name", "kappa", "umbilic"), [("saddle", (20.0, -15.0), False), ("bowl", (-12.5,) * 2, True)])
def test_curvatures_have_their_signs_and_directions(name, kappa, umbilic, method, truth):
    """κ in 1/m, never relative; at an umbilic the directions are flagged."""
    path = truth.path(name, T=truth.any_pose(1))
    e = fed(make(method), truth.samples(*path.noisy(*SIGMA, 0)))
    assert_sane(e)
    assert e.method == method
    assert np.allclose(e.normal, path.normals[-1], atol=0.02)
    assert e.kappa == pytest.approx(kappa, abs=1.5)
    assert e.kappa[0] >= e.kappa[1]
    assert e.umbilic == umbilic
    for k, d in zip(e.kappa, e.directions, strict=True):
        assert d @ e.curvature_tensor_base() @ d == pytest.approx(k)
        assert abs(d @ e.normal) < 1e-12


@pytest.mark.parametrize("method", METHODS)
def test_the_unit_of_length_changes_no_answer(method, truth):
    """Metres or kilometres: one answer within 1e-6, batch and online."""
    unit, answers = 1e-3, []
    path = truth.path("ellipsoid", T=truth.any_pose(2))
    p, n = path.noisy(*SIGMA, 3)
    for u in (1.0, unit):
        fit = fit_surface(u * p, n, sigma_point=u * SIGMA[0], sigma_normal=SIGMA[1], method=method)
        estimator = make_estimator(method, sigma_point=u * SIGMA[0], sigma_normal=SIGMA[1], memory_m=0.02 * u)
        for s in truth.samples(p, n):
            T = s.T_base_probe.copy()
            T[:3, 3] *= u
            estimator.add(ContactSample(s.t_s, u * s.p_base, s.n_base, T, u * s.r_probe, 1.0))
        answers.append((fit, estimator.estimate()))
    for one, other in zip(*answers, strict=True):
        assert np.allclose(other.K * unit, one.K, rtol=1e-6, atol=1e-6 * np.abs(one.K).max())
        assert np.allclose(other.covariance * unit**2, one.covariance, rtol=1e-5, atol=1e-9)
        assert other.rank == one.rank
        assert other.condition_number == pytest.approx(one.condition_number, rel=1e-5)


def test_standing_still_after_a_scan_changes_nothing(truth):
    """1e4 samples (1e6 in tests/bench): nothing is forgotten or made up."""
    path = truth.path("ellipsoid", T=truth.any_pose(3))
    estimator = make("recursive")
    fed(estimator, truth.samples(*path.noisy(*SIGMA, 0)))
    rng = np.random.default_rng(1)
    n, T, r = path.normals[-1], np.eye(4), np.array([0.0, 0.0, 0.04])
    cloud = path.points[-1] + SIGMA[0] * rng.normal(size=(5000, 3))
    for i in range(10_000):
        estimator.add(ContactSample(1.0 + 0.005 * i, cloud[i % 5000], n, T, r, 1.0))
        if i == 999:
            settled = estimator.estimate()
    after = estimator.estimate()
    assert estimator.dropped.total == 0
    assert_sane(after)
    assert after.samples == settled.samples
    assert np.allclose(np.linalg.eigvalsh(after.covariance), np.linalg.eigvalsh(settled.covariance), rtol=0.05)
    assert frobenius(path.error(after)) < 4.0 * math.sqrt(WEIGHT @ np.diag(after.covariance))


BAD = [
    ({"p_base": math.nan}, "not_finite"),
    ({"n_base": math.inf}, "not_finite"),
    ({"t_s": math.nan}, "not_finite"),
    ({"n_base": 2.0}, "not_unit"),
    ({"sigma_point": 0.0}, "zero_sigma"),
    ({"sigma_normal": 0.0}, "zero_sigma"),
    ({"sigma_point": math.nan}, "zero_sigma"),
    ({"t_s": 0.0}, "repeated"),
    ({"t_s": -1.0}, "backwards"),
]
"""What is wrong with a sample, and how it is counted: times are added, places and normals multiplied."""


def spoilt(s, change):
    """A sample after s that is bad."""
    times = {"t_s": s.t_s + change.get("t_s", 1e-3)}
    factors = {name: getattr(s, name) * change.get(name, 1.0) for name in ("p_base", "n_base")}
    return dataclasses.replace(s, **change | times | factors)


@pytest.mark.parametrize("method", METHODS)
def test_online_bad_samples_are_dropped_and_counted(method, truth):
    good = list(truth.samples(*truth.path("sphere").noisy(*SIGMA, 0)))
    estimator = make(method)
    e = fed(estimator, [*good[:81], *(spoilt(good[80], change) for change, _ in BAD), *good[81:]])
    wanted = Counter(counter for _, counter in BAD)
    assert {name: getattr(estimator.dropped, name) for name in wanted} == wanted
    assert estimator.dropped.total == wanted.total()
    assert np.array_equal(e.K, fed(make(method), good).K)


def with_outliers(path, share, size, seed):
    """A share of the samples with a wrong place, off by `size` (m) along every axis."""
    p, n = path.noisy(*SIGMA, seed)
    rng = np.random.default_rng(seed + 1000)
    wrong = rng.random(len(p)) < share
    p[wrong] += size * rng.normal(size=(int(wrong.sum()), 3))
    return p, n, int(wrong.sum())


def with_wrong_centroids(path, share, size, seed):
    """A share of the samples with a centroid that is `size` (m) off on the pad: place and normal are wrong together."""
    p, n = path.noisy(*SIGMA, seed)
    rng = np.random.default_rng(seed + 1000)
    wrong = np.flatnonzero(rng.random(len(p)) < share)
    for i in wrong:
        sideways = np.cross(n[i], rng.normal(size=3))
        angle = size / 0.04
        turned = math.cos(angle) * n[i] + math.sin(angle) * sideways / np.linalg.norm(sideways)
        p[i], n[i] = p[i] + 0.04 * (n[i] - turned), turned
    return p, n, len(wrong)


def figure(name, truth, n=400):
    """n samples on a figure of ±5 mm over a named surface."""
    s = np.arange(n) * 0.125e-3
    return truth.placed(truth.surface(name), 5e-3 * np.sin(s / 5e-3), 4e-3 * np.sin(s / 3.1e-3))


class TestOutliers:
    @pytest.mark.parametrize("method", MUST)
    @pytest.mark.parametrize(
        ("name", "size", "spoil"),
        [("plane", 1e-3, with_outliers), ("cylinder", 0.3e-3, with_wrong_centroids), ("saddle", 5e-3, with_outliers)],
    )
    def test_five_percent_have_bounded_influence_and_are_flagged(self, name, size, spoil, method, truth):
        path, worst = figure(name, truth), 0.0
        for seed in range(2):
            p, n, wrong = spoil(path, 0.05, size, seed)
            e = fed(make(method), truth.samples(p, n))
            assert wrong > 10
            assert_sane(e)
            assert any("reduced weight" in note for note in e.notes)
            assert not any("changed" in note for note in e.notes)
            worst = max(worst, frobenius(path.error(e)))
        assert worst < 1.0

    @pytest.mark.parametrize(("method", "doubt"), [("ml", Doubt.SATURATED), ("recursive", Doubt.DEAD)])
    def test_doubtful_images_count_less_and_are_told(self, method, doubt, truth):
        """Every eighth centroid 0.3 mm off, its image in doubt: told, and the answer is nearer than untold."""
        path, wide, plain = figure("cylinder", truth), [], []
        for seed in range(3):
            p, n, _ = with_wrong_centroids(path, 0.0, 0.0, seed)
            for i in range(0, 400, 8):
                turned = n[i] + 0.0075 * np.array([1.0, 0.0, 0.0])
                turned /= np.linalg.norm(turned)
                p[i], n[i] = p[i] + 0.04 * (n[i] - turned), turned
            told = [dataclasses.replace(s, doubts=() if i % 8 else (doubt,)) for i, s in enumerate(truth.samples(p, n))]
            e = fed(make(method, (2e-5, 3e-3)), told)
            assert_sane(e)
            assert any(doubt.value in note and note.startswith("20 of the last 160") for note in e.notes)
            wide.append(frobenius(path.error(e)))
            plain.append(frobenius(path.error(fed(make(method, (2e-5, 3e-3)), truth.samples(p, n)))))
        assert np.mean(wide) < np.mean(plain)
        assert max(wide) < 4.0

    @pytest.mark.parametrize("method", ["chen1996", "chord"])
    def test_the_baselines_only_stay_sane(self, method, truth):
        p, n, _ = with_outliers(truth.path("cylinder"), 0.05, 1e-3, 0)
        assert_sane(fed(make(method), truth.samples(p, n)))

    @pytest.mark.parametrize(
        ("method", "count", "share"), [*((method, 160, 0.0) for method in METHODS), ("recursive", 5_000, 0.05)]
    )
    def test_standing_still_is_no_path(self, method, count, share, truth):
        path = truth.placed(truth.surface("cylinder"), np.zeros(count), np.zeros(count))
        p, n, _ = with_outliers(path, share, 1e-3, 0)
        e = fed(make(method), truth.samples(p, n))
        if e is not None:
            assert_sane(e)
            assert method not in MUST or e.rank == 0


def fillet(k1, k2, seed):
    """A weave over a surface whose curvature along x jumps at x = 0: way past the jump, places, normals, x on them."""
    u = np.linspace(-0.03, 0.008, 100_001)
    y = 2.5e-3 * np.sin(2 * np.pi * u / 6e-3)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(u), np.diff(y)))])
    at = np.arange(0.0, s[-1], 0.125e-3)
    u, y = np.interp(at, s, u), np.interp(at, s, y)
    k = np.where(u < 0, k1, k2)
    flat = np.abs(k) < 1e-9
    r = 1.0 / np.where(flat, 1.0, k)
    a = np.where(flat, 0.0, k * u)
    points = np.stack([np.where(flat, u, r * np.sin(a)), y, np.where(flat, 0.0, r * (1 - np.cos(a)))], axis=1)
    normals = np.stack([np.sin(a), 0 * a, -np.cos(a)], axis=1)
    rng = np.random.default_rng(seed)
    noisy = normals + SIGMA[1] * rng.normal(size=normals.shape)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    tangent = np.stack([np.cos(a), 0 * a, np.sin(a)], axis=1)
    return at - at[np.argmax(u > 0)], points + SIGMA[0] * rng.normal(size=points.shape), noisy, tangent


LOOP_SIGMA = (1e-4, 4e-3)


@pytest.mark.parametrize(
    ("k1", "k2", "sigma"),
    [(0.0, 50.0, SIGMA), (0.0, 50.0, LOOP_SIGMA), (1 / 0.036, 0.0, SIGMA)],
    ids=["plane to cylinder", "plane to cylinder, sigmas of the loop", "cylinder to plane"],
)
def test_fillet(k1, k2, sigma, truth):
    """From 5 mm past a jump of curvature on, the RMS error along the path is below 5 % (on a plane below 1 per m).

    The bound of a single run is 2.6–3.5 % there: single answers may be further off, the RMS over runs may not. Where
    the loop's generous σ's are used, some runs are still marked unobserved for some millimetres more.
    """
    squares, seen = [], []
    for seed in range(3):
        way, p, n, tangent = fillet(k1, k2, seed)
        estimator = make("recursive", sigma)
        for i, sample in enumerate(truth.samples(p, n)):
            estimator.add(sample)
            if way[i] >= 5.2e-3 and i % 6 == 0:
                e = estimator.estimate()
                assert_sane(e)
                seen.append(e.rank == 3)
                if e.rank == 3:
                    squares.append((tangent[i] @ e.curvature_tensor_base() @ tangent[i] - k2) ** 2)
        assert any("changed" in note for note in e.notes)
    assert math.sqrt(np.mean(squares)) < max(0.05 * abs(k2), 1.0)
    assert np.mean(seen) > (0.99 if sigma is SIGMA else 0.75)


class TestMagnitudes:
    """Numbers at the ends of what a float holds: refused by name, or right; never a warning of numpy."""

    @staticmethod
    def cap():
        """(n, 3) points of a sphere of radius 1, and their normals."""
        away = np.random.default_rng(0).normal(size=(40, 3)) * 0.2 + (0.0, 0.0, 1.0)
        normals = away / np.linalg.norm(away, axis=1, keepdims=True)
        return normals, np.diag([1.0, 1.0, 1.0, -1.0])

    @pytest.mark.parametrize("field", ["sigma_point", "sigma_normal"])
    @pytest.mark.parametrize("sigma", [1e200, 1e-200, 10**400, 1e-200 * np.eye(3), 1e200 * np.eye(3)])
    def test_a_deviation_is_refused_by_name(self, field, sigma):
        n, S = self.cap()
        sigmas = {"sigma_point": 2e-5, "sigma_normal": 1e-3, field: sigma}
        for compute in (lambda: cramer_rao(n, n, S, **sigmas), lambda: fit_surface(n, n, **sigmas)):
            with pytest.raises(UsageError, match=f"^{field}: expected"):
                compute()

    @pytest.mark.parametrize("unit", [1e-50, 1e9])
    def test_a_bound_and_a_fit_have_the_unit_of_their_points(self, unit):
        n, S = self.cap()
        scaled = np.diag([1.0, 1.0, 1.0, -(unit**2)]) / unit
        bound = cramer_rao(n, n, S, sigma_point=2e-5, sigma_normal=1e-3)
        again = cramer_rao(unit * n, n, scaled, sigma_point=2e-5 * unit, sigma_normal=1e-3)
        assert again * unit**2 == pytest.approx(bound, rel=1e-6)
        estimate = fit_surface(unit * n, n, sigma_point=2e-5 * unit, sigma_normal=1e-3)
        assert estimate.kappa * unit == pytest.approx([1.0, 1.0], rel=1e-4)

    def test_a_bound_is_that_of_the_surface_however_its_matrix_is_scaled(self):
        n, S = self.cap()
        bound = cramer_rao(n, n, S, sigma_point=2e-5, sigma_normal=1e-3)
        for factor in (1e-55, 1e55):
            again = cramer_rao(n, n, factor * S, sigma_point=2e-5, sigma_normal=1e-3)
            assert again == pytest.approx(bound, rel=1e-9)

    @pytest.mark.parametrize("factor", [1e160, 1e-160])
    def test_a_matrix_is_refused(self, factor):
        with pytest.raises(UsageError, match=r"^S: expected"):
            SurfaceMatrix(factor * self.cap()[1])

    @pytest.mark.parametrize("factor", [1e160, 1e20])
    def test_points_are_refused(self, factor):
        n, S = self.cap()
        with pytest.raises(UsageError, match=r"^points: expected"):
            fit_surface(factor * n, n, sigma_point=2e-5, sigma_normal=1e-3)
        with pytest.raises(UsageError, match=r"^points: expected"):
            cramer_rao(factor * n, n, S, sigma_point=2e-5, sigma_normal=1e-3)
