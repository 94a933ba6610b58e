"""The filter's prior counts against faded samples by as much as makes the best of both."""

import math

import numpy as np
import pytest

from canprobe.mechanics.touch import Correlation, Prior
from canprobe.mechanics.touch.estimate.information import InformationFilter
from canprobe.mechanics.touch.estimate.noise import Noise, SlowErrors
from canprobe.mechanics.touch.estimate.nonlinear import DIFFUSE_INFORMATION
from canprobe.mechanics.touch.estimate.observed import curvature_covariance
from canprobe.mechanics.touch.estimate.omitted_terms import ExpectedMisfit, OmittedTerms
from canprobe.mechanics.touch.estimate.quadric import shifted, terms
from canprobe.mechanics.touch.estimate.residuals import curvature_jacobian, design
from canprobe.mechanics.touch.estimate.sandwich import Score
from canprobe.mechanics.touch.estimate.start import solved_once

MEMORY = 0.02
STEP = 0.5e-3
TINY = 2.0 * DIFFUSE_INFORMATION**2
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


@pytest.mark.parametrize(("path", "travelled"), [(0.0, 0.01), (0.005, 0.0), (0.2, 0.01)])
def test_the_prior_counts_as_the_samples_of_its_path_do(path, travelled):
    rows = np.random.default_rng(3).normal(size=(2, 3, 18))
    f, J = felt_along(path, rows, travelled), rows.reshape(-1, 18)[:, :9]
    weights = np.exp(-STEP / MEMORY * np.arange(round(path / STEP)))
    started = travelled * np.exp(-path / MEMORY)
    weight, square = started + STEP * weights.sum(), started * np.exp(-path / MEMORY) + STEP * (weights @ weights)
    share = square / weight
    assert information(f) == pytest.approx(weights.sum() * J.T @ J + share * prior(), abs=TINY)
    of_score = (weights @ weights) * J.T @ J + share**2 * prior()
    assert f.omitted.score.matrix[:9, :9] == pytest.approx(of_score, abs=TINY)


# What a filter keeps about the terms of its surface that a quadric has not.

RNG = np.random.default_rng


def low(x, y):
    """The part of f of the parameters (`quadric`) that is a polynomial of the place on the tangent plane."""
    return np.array([2 * x, 2 * y, 1.0, 0.0, 0.0, 0.0, x * x, 2 * x * y, y * y])


def higher(x, y):
    """The terms that a quadric leaves out."""
    return terms(np.array([[x, y, 0.0]]))[0, 0, 9:]


def test_terms_have_their_derivatives():
    X, h = RNG(0).uniform(-1, 1, (20, 3)), 1e-6
    at = terms(X)
    assert np.allclose(at[:, :, :9], terms(X, 9))
    for k, e in enumerate(h * np.eye(3)):
        assert np.allclose(at[:, 1 + k], (terms(X + e) - terms(X - e))[:, 0] / (2 * h), atol=1e-8)


def test_terms_about_another_place_are_the_same_surface():
    rng = RNG(2)
    a, (x0, y0) = rng.normal(size=9), rng.normal(size=2)
    A, Q = shifted(x0, y0)
    for x, y in rng.normal(size=(20, 2)):
        there = higher(x, y) @ (A @ a) + low(x, y) @ (Q @ a)
        assert there == pytest.approx(higher(x0 + x, y0 + y) @ a, rel=1e-12)


def test_a_variance_of_terms_is_alike_in_all_directions():
    angle = np.linspace(0.0, 2.0 * np.pi, 7)
    values = np.array([higher(math.cos(a), math.sin(a)) for a in angle])
    for which in (slice(0, 4), slice(4, 9)):
        assert np.allclose(np.square(values[:, which]).sum(axis=1), 1.0)


def test_sums_are_carried_along_as_if_they_were_taken_in_the_last_frame():
    """A weave over a surface, steps and changes of frame, against all samples at once from where it ends."""
    L, rng = 0.02, RNG(3)
    t = np.linspace(0.0, 1.0, 120)
    x, y = 0.02 * t, 0.004 * np.sin(11.0 * t)
    K = np.array([[14.0, 4.0], [4.0, -9.0]])
    slopes = np.stack([x, y], axis=1) @ K
    points = np.stack([x, y, 0.5 * np.einsum("ij,ij->i", np.stack([x, y], axis=1), slopes)], axis=1)
    points += 5e-6 * rng.normal(size=points.shape)
    normals = np.concatenate([slopes, -np.ones((len(t), 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    prior = Prior.weak(L)

    def at(T, part, c):
        R, n = T[:3, :3], len(points[part])
        d = design((points[part] - T[:3, 3]) @ R / L, normals[part] @ R, Noise(np.full(n, 2e-5 / L), np.full(n, 1e-3)))
        return solved_once(c, d, prior.rows(L))

    state = InformationFilter(L, prior, None)
    T = np.eye(4)
    now = at(T, slice(40), np.zeros(9))
    for _ in range(6):
        now = at(T, slice(40), now.target)
    state.adopt(T, now.c, now.root, now.rows, -now.r, 0.008)
    for k in range(40, 120, 4):
        step = at(state.T, slice(k, k + 4), state.c)
        state.take(step.rows, -step.r, 0.0)  # over no path nothing is forgotten
        state.follow(points[k + 3])
    assert np.linalg.norm(state.T[:3, 3] - points[-1]) < 1.5e-3  # the frame has come along
    whole = at(state.T, slice(None), state.c)
    flat = whole.rows.reshape(-1, 18)
    wanted, found = flat.T @ flat, state.omitted._information
    size = np.sqrt(np.diag(wanted))
    # what tilts is taken for level: over 0.22 rad here, cos⁴ of which is 0.91
    assert np.abs((found - wanted) / np.outer(size, size)).max() < 0.09
    slope = flat[:, 9:].T @ -whole.r.reshape(-1)
    assert np.abs((state.omitted._slope - slope) / size[9:]).max() < 0.5  # standard deviations
    score = state.omitted.score.matrix[9:, 9:]
    assert np.abs((score - wanted[9:, 9:]) / np.outer(size[9:], size[9:])).max() < 0.09


QUADRIC = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.1, 0.3])


def sums_of(seed, size):
    """Sums of 200 samples of a surface with terms that a quadric has not; rows, H of the quadric, and residuals."""
    rng = RNG(seed)
    J, E, e = rng.normal(size=(200, 3, 9)), rng.normal(size=(200, 3, 9)), rng.normal(size=600)
    rows = np.concatenate([J, E], axis=2)
    flat = rows.reshape(-1, 18)
    H = np.linalg.inv(flat[:, :9].T @ flat[:, :9])
    residuals = flat[:, 9:] @ (size * rng.normal(size=9)) + e
    residuals -= flat[:, :9] @ (H @ (flat[:, :9].T @ residuals))  # at the quadric that fits best
    sums = OmittedTerms(1e-9 * np.eye(9), None)
    sums.start(rows, residuals.reshape(-1, 3), 0.01)
    return sums, flat, H, residuals


def test_without_forgetting_an_answer_is_that_of_a_batch():
    """All rows at once: the terms' score has the covariance of their information, and both ways agree."""
    sums, flat, H, residuals = sums_of(4, 0.3)
    found = sums.amend(QUADRIC, H, np.zeros(3), ExpectedMisfit(), np.eye(3))
    both = np.linalg.lstsq(flat, residuals, rcond=None)[0]  # terms that show: those that fit best
    assert found.average.misfit > 0.999
    assert np.allclose(np.concatenate([found.average.shift, found.terms]), both, atol=0.02)
    wide = np.linalg.inv(flat.T @ flat)[:9, :9]
    spread = np.diag(H + found.covariance) / np.diag(wide)
    assert np.all(spread[:6] > 0.9)
    assert np.all(spread[:6] < 1.2)


def test_where_k_is_its_noise_the_others_hardly_count():
    """c13, c23, c33 put K off by a share of K; on a plane that is nothing, far from it all of it."""
    rng = RNG(5)
    deviation = np.diag([1e-3, 1e-3, 1e-3, 0.15, 0.15, 0.5, 0.02, 0.02, 0.02]) + 1e-4 * rng.normal(size=(9, 9))
    deviation[6, 3] = 0.05  # K11 goes with c13
    own = 4.0 * 0.02**2
    for size, share in ((0.005, 0.0), (10.0, 1.0)):
        c = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, size, 0.0, size])
        D = curvature_jacobian(c) @ deviation
        found = curvature_covariance(c, deviation)
        assert found[0, 0] == pytest.approx(own + share * ((D @ D.T)[0, 0] - own), rel=0.05)
        assert (np.linalg.eigvalsh(found) > 0.0).all()


# The running covariance of the score is the one of all rows at once.

STEPS = [(4, 0.5e-3, 0.9), (3, 0.6e-3, 0.8), (5, 0.4e-3, 0.95)]
PRIOR = np.diag(np.arange(1.0, 10.0))


def of_all(rows, places, weights, correlation, slow=None):
    """Σ_ij w_i w_j Σ_k ρ_k(s_i − s_j) J_ikᵀ J_jk, one kind of row k after the other."""
    total = np.zeros((9, 9))
    for kind, R in enumerate(correlation.matrix(places, slow)):
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


def test_slow_errors_and_those_along_the_path_add_up():
    correlation, rng = Correlation(1e-3, 0.6, 0.0, pad_length=0.3e-3), np.random.default_rng(3)
    rows, places, weights = stretch(rng)
    n = len(places)
    slow = SlowErrors(rng.uniform(0.5, 1.0, n), np.cumsum(rng.uniform(0.0, 0.1e-3, n)))
    score, done = Score(np.zeros((9, 9)), correlation), 0
    for J, (k, moved, kept) in zip(rows, STEPS, strict=True):
        here = slice(done, done := done + k)
        score.take(J.reshape(-1, 9), moved, kept, 0.0, SlowErrors(slow.share[here], slow.way[here]))
    assert np.allclose(score.matrix, of_all(np.concatenate(rows), places, weights, correlation, slow))


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


def test_information_about_curvature_fades_where_the_gradient_grows_along_the_path():
    """In the frame that moves on |∇f| at the samples falls below half; K would be known the better for it."""
    state, none = InformationFilter(0.02, Prior.weak(0.02), None), (np.zeros((0, 3, 18)), np.zeros((0, 3)))
    c = np.array([0.0, 0.0, 0.0, -0.5, 0.0, 0.0, 0.2, 0.0, 0.2])
    state.adopt(np.eye(4), c, 100.0 * np.eye(9), *none, 0.02)
    known = []
    for _ in range(20):
        state.take(*none, 1.2e-3)
        state.follow(state.T[:3, 3] + 1.2e-3 * state.T[:3, 0])
        known.append(-np.linalg.slogdet(state.inverse[6:] @ state.inverse[6:].T)[1])
    assert (np.diff(known[1:]) < 0.0).all()
    assert known[-1] < known[0] - 1.0
