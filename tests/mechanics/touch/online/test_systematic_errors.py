"""Errors that no path averages: regions that grow where answers change, and by scale, tool and pad."""

import numpy as np
import pytest

from canprobe.mechanics.touch import ContactSample, SystematicErrors, fit_surface
from canprobe.mechanics.touch.estimate.noise import CHI2_95
from canprobe.mechanics.touch.online.beyond import BEYOND_FACTOR, FASTEST_M_S, beyond_factor
from canprobe.mechanics.touch.online.regions import with_errors
from canprobe.mechanics.touch.online.systematic_errors import LAGS

MEMORY = 0.02
SIGMAS = {"sigma_point": 2e-5, "sigma_normal": 1e-3}
SAMPLE = ContactSample(0.0, np.zeros(3), np.array([0.0, 0.0, -1.0]), np.eye(4), np.array([0.0, 0.0, 0.04]), 1.0)


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
    """The last of the refined answers of these curvatures, a step apart, and the bare one."""
    bare = [answer(k, i * step) for i, k in enumerate(curvatures)]
    stage = SystematicErrors(MEMORY)
    return [stage.refine(one, SAMPLE) for one in bare][-1], bare[-1]


def test_where_answers_stay_their_regions_stay():
    found, bare = followed([20.0] * 12, 1e-3)
    assert np.array_equal(found.K, bare.K)
    assert np.allclose(found.covariance, bare.covariance, rtol=1e-3, atol=1e-6)


def test_a_region_grows_by_the_change_over_the_lag():
    """Curvature grows by 0.5 1/m a millimetre in both directions: a lag of 1.5 mm is 0.75 1/m of K11 and of K22."""
    found, bare = followed([20.0 + 0.5 * i for i in range(15)], 1e-3)
    added = found.covariance - bare.covariance
    expected = 0.5e3 * MEMORY * np.hypot(*(lag for _, lag in LAGS))
    assert np.sqrt(added[0, 0]) == pytest.approx(expected, rel=0.05)
    assert added[0, 2] == pytest.approx(expected**2, rel=0.1)
    assert abs(added[1, 1]) < 0.01 * expected**2
    assert np.array_equal(found.K, bare.K)


def test_a_region_grows_where_curvature_goes_up_and_down_within_millimetres():
    """Half a memory ago the curvature was the same; 2 mm ago it was another one."""
    found, bare = followed([20.0 + 6.0 * np.cos(2.0 * np.pi * i / 10.0) for i in range(21)], 1e-3)
    assert np.sqrt(found.covariance[0, 0] - bare.covariance[0, 0]) > 0.5


def test_a_region_holds_the_curvature_of_the_surface_that_an_offset_of_the_probe_shifts():
    """A centre that is 0.2 mm off along the normal shows a ball of radius 12 mm as one of 12.2 mm."""
    radius, offset = 0.012, 2e-4
    t = np.linspace(-1.0, 0.0, 120)
    points, normals = sphere(1.0 / radius, 0.006 * t, 0.003 * np.sin(9.0 * t))
    bare = fit_surface(points + offset * normals, normals, **SIGMAS)
    found = SystematicErrors(MEMORY, offset=offset).refine(bare, SAMPLE)
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

    def square(**errors):
        covariance = SystematicErrors(MEMORY, **errors).refine(bare, SAMPLE).covariance
        return float(off @ np.linalg.solve(covariance - bare.covariance + 1e-4 * np.eye(3), off))

    assert square(scale=0.084) > CHI2_95  # an error that all curvatures have in common does not turn directions
    assert square(drag=0.03) < CHI2_95


def test_what_is_beyond_the_settings_widens_all_alike():
    bare = answer(20.0)
    found = SystematicErrors(MEMORY, wider=beyond_factor(np.log(2.0), 2.0 * FASTEST_M_S)).refine(bare, SAMPLE)
    factor = (1.0 + BEYOND_FACTOR * np.log(2.0)) ** 2
    assert np.allclose(found.covariance, factor**2 * bare.covariance) and np.array_equal(found.K, bare.K)
    assert beyond_factor(0.0, FASTEST_M_S) == 1.0


def test_a_jump_is_doubted_for_as_long_as_the_span():
    n = round(max(span for span, _ in LAGS) * MEMORY / 1e-3)
    soon, bare = followed([5.0] * 12 + [30.0] * 3, 1e-3)
    later, _ = followed([5.0] * 12 + [30.0] * (n + 2), 1e-3)
    assert soon.covariance[0, 0] > bare.covariance[0, 0] + 3.0**2
    assert np.allclose(later.covariance, bare.covariance, rtol=0.2)


def test_all_that_is_known_agrees_after_an_error_is_added():
    """Covariance, information and the root of the whole model are those of one more error."""
    bare = answer(20.0)
    late = np.diag([2.0, 1.0, 0.0])
    found = with_errors(bare, late)
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
