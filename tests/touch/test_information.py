"""The filter's prior counts against faded samples by as much as makes the best of both."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.touch.estimators.information import InformationFilter
from canprobe.touch.nonlinear import DIFFUSE
from canprobe.touch.prior import Prior

MEMORY = 0.02
STEP = 0.5e-3
TINY = 2.0 * DIFFUSE**2
"""Of information: what keeps roots regular is added once more."""


def felt_along(path, rows, travelled=0.0):
    """A filter that starts with the prior and takes the same rows (2, 3, 18) at every step of a path (m)."""
    f = InformationFilter(MEMORY, Prior.weak(MEMORY), None)
    f.adopt(np.eye(4), np.zeros(9), f.root, np.zeros((1, 3, 18)), np.zeros((1, 3)), travelled)
    for _ in range(round(path / STEP)):
        f.take(rows, np.zeros((2, 3)), STEP)
    return f


def information(f):
    return f.root.T @ f.root


def prior():
    return information(InformationFilter(MEMORY, Prior.weak(MEMORY), None))


@pytest.mark.parametrize(("path", "travelled"), [(0.0, 0.01), (0.005, 0.0), (0.01, 0.01), (0.2, 0.01)])
def test_the_prior_counts_as_the_samples_of_its_path_do(path, travelled):
    f = felt_along(path, np.zeros((2, 3, 18)), travelled)
    weights = np.exp(-STEP / MEMORY * np.arange(round(path / STEP)))
    started = travelled * np.exp(-path / MEMORY)
    weight, square = started + STEP * weights.sum(), started * np.exp(-path / MEMORY) + STEP * (weights @ weights)
    assert information(f) == pytest.approx(square / weight * prior(), abs=TINY)
    assert f.left_out.score.matrix[:9, :9] == pytest.approx((square / weight) ** 2 * prior(), abs=TINY)


def test_after_a_long_path_it_counts_by_half():
    f = felt_along(0.4, np.zeros((2, 3, 18)))
    assert information(f)[3:6, 3:6] == pytest.approx(0.5 * prior()[3:6, 3:6], rel=0.02)


@pytest.mark.parametrize("path", [0.01, 0.02, 0.1])
def test_no_other_prior_leaves_less_error_on_surfaces_as_it_says(path):
    rows = np.random.default_rng(3).normal(size=(2, 3, 18))
    f = felt_along(path, rows)
    J = rows.reshape(-1, 18)[:, :9]
    weights = np.exp(-STEP / MEMORY * np.arange(round(path / STEP)))
    A, B, P = weights.sum() * J.T @ J, (weights @ weights) * J.T @ J, prior()

    def expected_error(H, share):
        """Mean square of the nine, over noise and over surfaces drawn from the prior."""
        return np.trace(H @ (B + share**2 * P) @ H)

    share = (weights @ weights) / weights.sum()
    assert information(f) == pytest.approx(A + share * P, abs=TINY)
    assert f.left_out.score.matrix[:9, :9] == pytest.approx(B + share**2 * P, abs=TINY)
    least = expected_error(np.linalg.inv(information(f)), share)
    for other in (0.25, 0.9 * share, 1.1 * share, 1.5):
        assert expected_error(np.linalg.inv(A + other * P), other) > least
