"""Regions that grow where answers change, and a window that ends at a change of the surface."""

from types import SimpleNamespace

import numpy as np
import pytest

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.change import ChangeTest
from canprobe.mechanics.touch.estimate.fit import fit_surface, make_estimator
from canprobe.mechanics.touch.estimate.following import LAG_SHARE, SPAN_SHARE, FollowingEstimator, less_certain
from canprobe.mechanics.touch.estimate.noise import CHI2_95, Correlation
from canprobe.mechanics.touch.estimate.recursive import CHANGING_NOTE
from canprobe.mechanics.touch.patch.curvature import MAX_RECENT_FRAMES, MIN_FRAMES, RECENT_OUTLIER_SHARE, _Mean

MEMORY = 0.02
SIGMAS = {"sigma_point": 2e-5, "sigma_normal": 1e-3}


def sphere(curvature, x, y):
    """Points and outward normals on a ball of a curvature that touches z = 0 at the origin, z inward."""
    slope = curvature * np.stack([x, y], axis=1)
    normals = np.concatenate([slope, -np.sqrt(1.0 - np.sum(slope**2, axis=1))[:, None]], axis=1)
    z = (1.0 - np.sqrt(1.0 - np.sum(slope**2, axis=1))) / max(curvature, 1e-12)
    return np.stack([x, y, z], axis=1), normals


def answer(curvature, at=0.0):
    """An estimate of a ball at a place x = at."""
    t = np.linspace(-1.0, 0.0, 120)
    points, normals = sphere(curvature, 0.012 * t, 0.004 * np.sin(9.0 * t))
    return fit_surface(points + np.array([at, 0.0, 0.0]), normals, **SIGMAS)


def followed(curvatures, step):
    """The last answer of the wrapper over answers of these curvatures, a step apart, and the bare one."""
    bare = [answer(k, i * step) for i, k in enumerate(curvatures)]
    coming = iter(bare)
    estimator = FollowingEstimator(SimpleNamespace(estimate=lambda: next(coming), reset=lambda: None), MEMORY)
    return [estimator.estimate() for _ in bare][-1], bare[-1]


def test_where_answers_stay_their_regions_stay():
    found, bare = followed([20.0] * 12, 1e-3)
    assert np.array_equal(found.K, bare.K)
    assert np.allclose(found.covariance, bare.covariance, rtol=1e-3, atol=1e-6)


def test_a_region_grows_by_the_change_over_the_lag():
    """Curvature grows by 0.5 1/m a millimetre in both directions: the lag of 1.5 mm is 0.75 1/m of K11 and of K22."""
    found, bare = followed([20.0 + 0.5 * i for i in range(15)], 1e-3)
    added = found.covariance - bare.covariance
    expected = 0.5e3 * LAG_SHARE * MEMORY
    assert np.sqrt(added[0, 0]) == pytest.approx(expected, rel=0.05)
    assert added[0, 2] == pytest.approx(expected**2, rel=0.1)
    assert abs(added[1, 1]) < 0.01 * expected**2
    assert np.array_equal(found.K, bare.K)


def test_a_region_holds_the_curvature_of_the_surface_that_an_offset_of_the_probe_shifts():
    """A centre that is 0.2 mm off along the normal shows a ball of radius 12 mm as one of 12.2 mm."""
    radius, offset = 0.012, 2e-4
    t = np.linspace(-1.0, 0.0, 120)
    points, normals = sphere(1.0 / radius, 0.006 * t, 0.003 * np.sin(9.0 * t))
    bare = fit_surface(points + offset * normals, normals, **SIGMAS)
    once = SimpleNamespace(estimate=lambda: bare, reset=lambda: None)
    found = FollowingEstimator(once, MEMORY, offset=offset).estimate()
    shown = bare.K - np.eye(2) / radius
    assert np.diag(shown) == pytest.approx(1.0 / (radius + offset) - 1.0 / radius, rel=0.2)
    added = np.sqrt(np.diag(found.covariance - bare.covariance))
    assert added[[0, 2]] == pytest.approx(np.abs(np.diag(shown)), rel=0.2)


@pytest.mark.parametrize("error", [[[0.0, -0.05], [0.05, 0.0]], [[0.05, 0.0], [0.0, -0.05]], [[0.0, 0.05], [0.0, 0.0]]])
def test_a_region_holds_the_curvature_that_a_pad_with_wrong_ways_shows(error):
    """A probe that keeps its orientation goes round on a saddle; its array turns, stretches or shears the ways."""
    K, (x, y) = np.diag([12.0, -9.0]), 6e-3 * np.array([np.cos(a := np.linspace(0.0, 12.0, 240)), np.sin(a)])
    way = np.stack([x, y], axis=1) @ K
    heights = 0.5 * np.einsum("ij,ij->i", np.stack([x, y], axis=1), way)
    slopes = way @ (np.eye(2) + error).T
    normals = np.concatenate([slopes, -np.ones((len(x), 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    bare = fit_surface(np.stack([x, y, heights], axis=1), normals, sigma_point=2e-4, sigma_normal=1e-3, coupling=25.0)
    P = bare.T_frame_contact[:3, :2]
    off = (bare.K - P[:2].T @ K @ P[:2])[[0, 0, 1], [0, 1, 1]]
    once = SimpleNamespace(estimate=lambda: bare, reset=lambda: None)

    def square(**errors):
        covariance = FollowingEstimator(once, MEMORY, **errors).estimate().covariance
        return float(off @ np.linalg.solve(covariance - bare.covariance + 1e-4 * np.eye(3), off))

    assert square(scale=0.084) > CHI2_95  # an error that all curvatures have in common does not turn directions
    assert square(drag=0.03) < CHI2_95


def test_a_jump_is_doubted_for_as_long_as_the_span():
    n = round(SPAN_SHARE * MEMORY / 1e-3)
    soon, bare = followed([5.0] * 12 + [30.0] * 3, 1e-3)
    later, _ = followed([5.0] * 12 + [30.0] * (n + 2), 1e-3)
    assert soon.covariance[0, 0] > bare.covariance[0, 0] + 3.0**2
    assert np.allclose(later.covariance, bare.covariance, rtol=0.2)


def test_all_that_is_known_agrees_after_an_error_is_added():
    """Covariance, information and the root of the whole model are those of one more error."""
    bare = answer(20.0)
    late = np.diag([2.0, 1.0, 0.0])
    found = less_certain(bare, late)
    P = bare.T_frame_contact[:3, :2]
    K = P.T @ late @ P
    v = np.array([K[0, 0], K[0, 1], K[1, 1]])
    assert np.allclose(found.covariance, bare.covariance + np.outer(v, v))
    before, after = (np.linalg.inv(e.model_root.T @ e.model_root) for e in (bare, found))
    half = np.concatenate([np.zeros(6), 0.5 * v])
    # c11, c12, c22 are half of K's entries
    assert np.allclose(after[6:, 6:] - before[6:, 6:], np.outer(half, half)[6:, 6:], rtol=1e-5, atol=1e-6)
    to_q = np.array([1.0, np.sqrt(2.0), 1.0])
    grown = np.linalg.inv(found.information) - np.linalg.inv(bare.information)
    assert np.allclose(grown, np.outer(to_q * v, to_q * v), rtol=1e-6, atol=1e-9)


def over_an_edge(estimator, every):
    """An answer to every such contact of 260 from a plane into an arc of 30 mm, which begins at the 176th."""
    rng = np.random.default_rng(3)
    s = np.arange(260) * 0.125e-3
    x, y = s - 0.022, 0.003 * np.sin(s / 0.6e-3 * 0.5)
    angle = np.maximum(x, 0.0) / 0.03
    points = np.stack([np.where(x > 0.0, 0.03 * np.sin(angle), x), y, 0.03 * (1.0 - np.cos(angle))], axis=1)
    normals = np.stack([np.sin(angle), 0.0 * x, -np.cos(angle)], axis=1)
    points += 2e-5 * rng.normal(size=points.shape)
    normals += 1e-3 * rng.normal(size=points.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    for i in range(260):
        estimator.add(ContactSample(5e-3 * i, points[i], normals[i], np.eye(4), np.array([0.0, 0.0, 0.04]), 1.0))
        if i % every == every - 1:
            yield estimator.estimate()


def test_ml_forgets_what_was_before_an_edge():
    """Soon after the edge the window holds only the arc."""
    answers = list(over_an_edge(make_estimator("ml", memory_m=MEMORY, window=160, **SIGMAS), every=8))
    assert any("surface changed" in note for found in answers if found is not None for note in found.notes)
    assert answers[-1].kappa[0] == pytest.approx(1.0 / 0.03, rel=0.05)
    assert answers[-1].samples < 120


def test_nothing_is_observed_where_the_surface_may_be_changing():
    """Between the edge and the alarm, which correlated noise puts off."""
    settings = SIGMAS | {"correlation": Correlation(2e-3, 0.0, 0.2)}
    answers = list(over_an_edge(make_estimator("recursive", memory_m=MEMORY, window=160, **settings), every=1))
    doubtful = [i for i, found in enumerate(answers) if found is not None and CHANGING_NOTE in found.notes]
    assert 176 < doubtful[0] <= doubtful[-1] < 200
    assert all(answers[i].rank == 0 and answers[i].evidence is None for i in doubtful)
    assert answers[-1].rank == 3 and answers[-1].kappa[0] == pytest.approx(1.0 / 0.03, rel=0.1)


def test_a_mean_of_moments_takes_a_row_of_far_ones_for_a_change_and_a_single_one_for_wrong():
    mean = _Mean(MAX_RECENT_FRAMES, RECENT_OUTLIER_SHARE)
    for _ in range(20):
        mean.add(1.0, 0.0, 1.0)
    mean.add(5.0, 0.0, 5.0)
    mean.add(1.0, 0.0, 1.0)
    assert mean.moments[0] == pytest.approx(1.0, abs=0.05)
    for _ in range(MIN_FRAMES + 1):
        mean.add(2.0, 0.1, 1.5)
    assert mean.moments == pytest.approx((2.0, 0.1, 1.5))


# The innovation test: isolated wrong samples are no change of the surface, a run of them is.


def fed(squares, scale=1.0):
    """Samples up to the first alarm; None where there was none."""
    test = ChangeTest()
    for i, square in enumerate(squares):
        if test.take(scale * square):
            return i
    return None


def chi2(n, seed):
    return np.random.default_rng(seed).chisquare(3, n)


@pytest.mark.parametrize("scale", [0.05, 1.0, 1.8])
def test_noise_of_any_stated_size_sets_nothing_off(scale):
    assert all(fed(chi2(4000, seed), scale) is None for seed in range(5))


def test_five_percent_gross_outliers_set_nothing_off_but_in_one_run_of_fifty():
    """Where they come four in a row they look like a change."""
    alarms = 0
    for seed in range(100):
        squares = chi2(480, seed)
        squares[np.random.default_rng(seed + 100).random(480) < 0.05] = 1e4
        alarms += fed(squares) is not None
    assert alarms <= 2


def test_a_burst_of_three_does_not_and_a_lasting_change_does_within_ten():
    burst, lasting = chi2(400, 1), chi2(400, 1)
    burst[200:203] = 1e4
    lasting[200:] = 40.0 * lasting[200:]
    assert fed(burst) is None
    assert 200 < fed(lasting) <= 210


def test_an_alarm_is_counted_and_the_test_begins_again():
    test = ChangeTest()
    for square in chi2(200, 2):
        test.take(square)
    usual = test.usual
    while not test.take(100.0):
        pass
    assert test.innovation > 2.0
    test.alarm()
    assert test.alarms == 1
    assert test.innovation == pytest.approx(usual, rel=0.2)
    assert not test.take(3.0)
