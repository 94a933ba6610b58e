"""The innovation test: isolated wrong samples are no change of the surface, a run of them is."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.touch.estimators.change import ChangeTest


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
