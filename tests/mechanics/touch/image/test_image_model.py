"""The image model against an integrated Winkler patch, blurred on a fine grid, and against its differences."""

import math
from dataclasses import replace

import numpy as np
import pytest
from image_models import FORCE, LEVEL_PA, PARAMETERS, PITCH, RADIUS, STIFFNESS, entries, model, tensor
from scipy.ndimage import gaussian_filter


def shown_by_hand(K, force, parameters, level):
    """Sum (N) and second moments (m²) of k (δ − ½ xᵀ (I/R + K) x)₊, blurred, spread and cut off, on a fine grid."""
    step, n = PITCH / 8, 128
    x, y = np.meshgrid(*(2 * [(np.arange(n) - (n - 1) / 2) * step]))
    A = 0.5 * (np.eye(2) / RADIUS + K)
    depth = math.sqrt(2.0 * force * math.sqrt(np.linalg.det(A)) / (math.pi * STIFFNESS))
    p = STIFFNESS * np.maximum(depth - A[0, 0] * x * x - 2 * A[0, 1] * x * y - A[1, 1] * y * y, 0.0)
    p = parameters.scale * gaussian_filter(p, parameters.blur / step, mode="constant", truncate=6.0)
    c = parameters.crosstalk / 15
    spread = np.eye(n) * (1 - parameters.crosstalk - c) + c * step / PITCH
    p = spread @ p @ spread
    cut = np.maximum(p - level, 0.0)
    total = p[p >= level].sum() * step * step
    return total, [(cut * m).sum() / cut.sum() for m in (x * x, x * y, y * y)]


@pytest.mark.parametrize("shape", [(27.8, 0.0, 0.4), (20.0, 20.0, 0.0), (16.0, -12.0, 1.1), (45.0, 10.0, 0.0)])
@pytest.mark.parametrize(("crosstalk", "level"), [(0.0, 1e-3), (0.02, LEVEL_PA)])
def test_moments_and_sum_are_those_of_the_blurred_patch_on_a_fine_grid(shape, crosstalk, level):
    K = tensor(*shape[:2], 0.0 if crosstalk else shape[2])  # crosstalk follows rows and columns
    parameters = replace(PARAMETERS, crosstalk=crosstalk)
    m = model(parameters, level)
    total, moments = shown_by_hand(K, FORCE, parameters, level)
    found = m.moments(entries(K), FORCE)
    scale = math.sqrt(moments[0] * moments[2])
    assert found == pytest.approx(moments, rel=6e-3, abs=6e-3 * scale)
    a, b = (0.5 * (1 / RADIUS + k) for k in shape[:2])
    sums = m.sum_of(m.shown(*(np.array([x]) for x in (m.depth(FORCE, a * b), a, b))))
    assert sums[0] == pytest.approx(total, rel=8e-3)


def test_force_gains_undo_what_the_rim_loses():
    m = model()
    gain, edge = m.force_gains((0.5, 1.0, 2.0, 4.0), ((0.0, 0.0), (1.6, 1.6)))
    for force in (0.7, 3.0):
        S, _ = shown_by_hand(tensor(20.0, 0.0, 0.0), force, PARAMETERS, LEVEL_PA)
        assert gain * S + edge * math.sqrt(S) == pytest.approx(force, rel=0.015)


@pytest.mark.parametrize("k", [(27.8, 0.0, 3.0), (20.0, 6.0, -3.0), (15.0, 1e-5, 15.0)])
def test_the_jacobian_is_that_of_the_moments(k):
    m = model()
    v = m.moments(k, FORCE)
    J, residual, _ = m.linearised((v[0], 0.0, v[2]), FORCE, 8, k)
    scale = np.array([1.0 / v[0], 1.0 / math.sqrt(v[0] * v[2]), 1.0 / v[2]])
    assert residual == pytest.approx(scale * [0.0, -v[1], 0.0], abs=1e-12)

    def of(q):
        return np.array(m.moments((q[0], q[1] / math.sqrt(2.0), q[2]), FORCE))

    q, h = np.array([k[0], math.sqrt(2.0) * k[1], k[2]]), 0.05 * np.eye(3)
    numeric = np.stack([(of(q + d) - of(q - d)) / 0.1 for d in h], axis=1) * scale[:, None]
    assert pytest.approx(numeric, rel=0.02, abs=2e-4) == J


def test_hollow_as_tight_as_the_probe_is_no_patch():
    with pytest.raises(ValueError, match="hollower"):
        model().moments((10.0, 0.0, -25.0), FORCE)
    with pytest.raises(ValueError, match="hollower"):
        model().trust((10.0, 0.0, -25.0), FORCE)


def test_trust_ends_softly_where_the_calibration_ends():
    k = np.linspace(0.0, 2000.0, 8001)
    trust = np.array([model().trust((a, 0.0, a), FORCE) for a in k])
    assert trust[0] == model().trust((27.8, 0.0, 0.0), FORCE) == 1.0
    assert trust[-1] == 0.0
    assert np.all(np.diff(trust) <= 0.0)
    assert np.abs(np.diff(trust)).max() < 0.02
