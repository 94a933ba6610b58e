"""The running covariance of the score is the one of all rows at once."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.touch.estimators.score import Score
from canprobe.touch.noise import Correlation

STEPS = [(4, 0.5e-3, 0.9), (3, 0.6e-3, 0.8), (5, 0.4e-3, 0.95)]
PRIOR = np.diag(np.arange(1.0, 10.0))


def of_all(rows, places, weights, correlation):
    """Σ_ij w_i w_j Σ_k ρ_k(s_i − s_j) J_ikᵀ J_jk, one kind of row k after the other."""
    total = np.zeros((9, 9))
    for kind, R in enumerate(correlation.matrix(places)):
        J = rows[:, kind] * weights[:, None]
        total += J.T @ R @ J
    return total


def stretch(rng):
    """Rows, their places along the path and what forgetting leaves of them."""
    rows = [rng.normal(size=(n, 3, 9)) for n, _, _ in STEPS]
    ends = np.cumsum([0.0] + [moved for _, moved, _ in STEPS])
    places = [ends[k] + moved / n * np.arange(1.0, n + 1.0) for k, (n, moved, _) in enumerate(STEPS)]
    kept = [np.full(n, np.prod([later for _, _, later in STEPS[k + 1 :]])) for k, (n, _, _) in enumerate(STEPS)]
    return rows, np.concatenate(places), np.concatenate(kept)


@pytest.mark.parametrize("correlation", [Correlation(1e-3, 0.8), Correlation(0.4e-3, 0.9, 0.1)])
def test_steps_add_up_across_a_change_of_frame(correlation):
    rng = np.random.default_rng(0)
    rows, places, weights = stretch(rng)
    back = np.eye(9) + 0.2 * rng.normal(size=(9, 9))
    score = Score(np.zeros((9, 9)), correlation)
    for k, (J, (_, moved, kept)) in enumerate(zip(rows, STEPS, strict=True)):
        score.take((J if k < 2 else J @ back).reshape(-1, 9), moved, kept, 0.0)
        if k == 1:
            score.carry(back)
    assert np.allclose(score.matrix, of_all(np.concatenate(rows) @ back, places, weights, correlation))


def test_a_batch_goes_on_as_steps():
    correlation, rng = Correlation(1e-3, 0.7), np.random.default_rng(1)
    first, then = rng.normal(size=(6, 3, 9)), rng.normal(size=(2, 3, 9))
    score = Score(PRIOR, correlation)
    score.start(first, 1e-3)
    score.take(then.reshape(-1, 9), 0.4e-3, 0.9, 1.0 - 0.9**2)
    places = np.concatenate([np.linspace(0.0, 1e-3, 6), [1.2e-3, 1.4e-3]])
    weights = np.array(6 * [0.9] + 2 * [1.0])
    assert np.allclose(score.matrix, PRIOR + of_all(np.concatenate([first, then]), places, weights, correlation))


def test_independent_rows_count_with_their_weight_squared():
    J = np.random.default_rng(2).normal(size=(2, 9, 9))
    score = Score(PRIOR, None)
    score.take(J[0], 1e-3, 0.9, 1.0 - 0.9**2)
    score.take(J[1], 1e-3, 0.5, 1.0 - 0.5**2)
    assert np.allclose(score.matrix, PRIOR + 0.25 * J[0].T @ J[0] + J[1].T @ J[1])
    score.reset()
    assert np.allclose(score.matrix, PRIOR)
