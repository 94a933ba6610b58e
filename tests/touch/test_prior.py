"""The prior on curvature prefers no direction: it looks at the tensor as a whole."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.touch.prior import Prior

LENGTH, SIGMA = 0.01, 25.0


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4, 1.9])
@pytest.mark.parametrize("kappa", [(30.0, 10.0), (30.0, -30.0), (20.0, 0.0)])
def test_a_flat_prior_weighs_the_curvature_tensor_alike_from_every_side(kappa, angle):
    """Σ ((K11 / σ)², (K12 / (σ √½))², (K22 / σ)²) is the tensor's norm over σ, which no turn of the axes changes."""
    turn = np.array(((np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))))
    K = turn @ np.diag(kappa) @ turn.T
    rows, wanted = Prior.flat(LENGTH, SIGMA).rows(LENGTH)
    half = np.zeros(9)
    half[6:] = 0.5 * LENGTH * np.array((K[0, 0], K[0, 1], K[1, 1]))
    assert wanted.tolist() == [0.0] * 6
    assert np.linalg.norm(rows @ half) == pytest.approx(np.hypot(*kappa) / SIGMA, rel=1e-12)
