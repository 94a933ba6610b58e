"""A change of the surface: what the estimators forget, and what the test takes for one."""

import numpy as np
import pytest

from canprobe.mechanics.touch import ContactSample, Correlation, make_estimator
from canprobe.mechanics.touch.estimate.change import ChangeTest
from canprobe.mechanics.touch.estimate.recursive import CHANGING_NOTE

MEMORY = 0.02
SIGMAS = {"sigma_point": 2e-5, "sigma_normal": 1e-3}


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


@pytest.mark.parametrize("scale", [0.05, 1.8])
def test_noise_of_any_stated_size_sets_nothing_off(scale):
    assert all(fed(chi2(4000, seed), scale) is None for seed in range(5))


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
