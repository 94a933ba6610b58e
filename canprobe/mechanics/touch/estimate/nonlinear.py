"""Batch Gauss–Newton on the local model, robust.

The points have errors as the normals do, so that the residuals are whitened by `σ_n² I + K² σ_p²`: that keeps the fit
at the Cramér–Rao bound also on tight curvature. Beyond the 99.9 % point of χ² with three degrees of freedom samples
lose weight (`robust`), measured against the median residual where that is larger than expected.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.estimate.noise import CHI2_999, CHI2_MEDIAN, mixed
from canprobe.mechanics.touch.estimate.observed import Decision, decide, spread_of
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, size_of
from canprobe.mechanics.touch.estimate.residuals import Design, linear_rows, linearise
from canprobe.mechanics.touch.linear_algebra import solved, upper_root
from canprobe.mechanics.types import Floats

DIFFUSE_INFORMATION = 1e-2
"""Root of the information, in units of the length, that keeps a root regular: K known to ±200/length."""
_STEP_TOLERANCE = 3e-8
_MAX_ITERATIONS = 40
_MAX_START_ROUNDS = 8
_MAX_COST_RISE_SHARE = 0.05
"""Rise of the cost that a step may bring: the steps end where the residuals balance, which is not quite where the cost
is least, since the whitening changes with K and wrong samples pull."""
_START_PRIOR_NARROWING = 10.0
"""How much narrower the linear start takes the prior on c13, c23, c33."""
_GROSS_SQUARE_RATIO = 60.0
"""Squared residual over its scale, of some sample, at which the linear start is made robust."""


class QuadricFit(NamedTuple):
    """A converged batch fit in its working frame, dimensionless.

    Attributes:
        c: (9,) parameters.
        root: (9, 9) upper triangular information root, prior included.
        decision: rank decision on the data.
        free: (9,) parameters with nothing held, and
        free_root: (9, 9) root of their information, kept regular by next to nothing (`DIFFUSE_INFORMATION`).
        innovation: weighted χ² per degree of freedom.
        outliers: samples with less than full weight.
        converged: the last step was below the tolerance.
    """

    c: Floats
    root: Floats
    decision: Decision
    free: Floats
    free_root: Floats
    innovation: float
    outliers: int
    converged: bool


def fit(d: Design, prior: tuple[Floats, Floats], independent: Floats | None = None) -> QuadricFit:
    """Fit the model to a design with a prior (`Prior.rows`).

    `independent` (3, n, n) makes correlated whitened samples independent (`Correlation.whitener`); None: they are.
    """
    spread = spread_of(d.X, d.point_variance)
    c, root, decision = linear_start(d, prior, spread)
    best_cost, step, halvings, converged = np.inf, np.zeros(9), 0, False
    best = c
    for _ in range(_MAX_ITERATIONS):
        at = linearise(c, d)
        square = np.einsum("ij,ij->i", at.r, at.r)
        weight, cost = robust(square)
        w = np.sqrt(weight)[:, None]
        r, J = at.r * w, at.jacobian() * w[:, :, None]
        if independent is not None:
            beyond = cost - float(weight @ square)
            r, J = mixed(independent, r[:, :, None])[:, :, 0], mixed(independent, J)
            cost = float(np.sum(r * r)) + beyond
        # without the prior's part a large c33 on a short path, which flattens f/|∇f|, would look good. The noise's
        # log-determinant has no place here: with the feet as unknowns it does not belong to the likelihood, and on
        # tight curvature it draws K down by a tenth
        assumed = prior[0] @ c - prior[1]
        cost += float(assumed @ assumed)
        if cost > (1.0 + _MAX_COST_RISE_SHARE) * best_cost and halvings < 12:
            step, halvings = 0.5 * step, halvings + 1
            c = best + step
            continue
        best, best_cost, halvings = c, cost, 0
        A, residuals = J.reshape(-1, 9), r.reshape(-1)
        b, chi2 = A @ c - residuals, float(residuals @ residuals)
        target, root, decision = solve_rows(A, b, prior, spread, size_of(c), known=decision)
        step = target - best
        c = target
        if np.abs(step).max() < _STEP_TOLERANCE:
            final = solve_rows(A, b, prior, spread, size_of(c))
            if final[2].rank == decision.rank:
                c, root, decision = final
                converged = True
                break
            decision = final[2]
    c = c if converged else best
    has_prior = bool(prior[0][3:].any())
    free, free_root = (c, root) if has_prior else _freed(best, A, residuals, root, prior)
    freedom = max(3 * len(square) - 6 - decision.rank, 1)
    return QuadricFit(c, root, decision, free, free_root, chi2 / freedom, int(np.sum(weight < 1.0)), converged)


def _freed(c: Floats, J: Floats, r: Floats, root: Floats, prior: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """One more step with nothing held."""
    regular = upper_root(np.concatenate([root, DIFFUSE_INFORMATION * np.eye(9)]))
    gradient = J.T @ r + prior[0].T @ (prior[0] @ c - prior[1])
    return c - solved(regular, solved(regular.T, gradient)), regular


def linear_start(
    d: Design, prior: tuple[Floats, Floats], spread: Floats, weight: Floats | None = None
) -> tuple[Floats, Floats, Decision]:
    """The linear solution, as of `solve_rows`; where some samples are far off, again with weights that fall with the
    square. `weight` (n,) is that to begin with.
    """
    A, b = linear_rows(d)
    # the points' noise in z² and its kin would draw c13, c23, c33 far off, from where there is no way back
    prior = np.concatenate([_START_PRIOR_NARROWING * prior[0][:3], prior[0][3:]]), prior[1]
    w = np.ones(len(b)) if weight is None else np.sqrt(weight).repeat(3)
    answer = solve_rows(A * w[:, None], b * w, prior, spread, 0.0)
    for _ in range(_MAX_START_ROUNDS):
        square = np.square(A @ answer[0] - b).reshape(-1, 3).sum(axis=1)
        scale = _median(square) / CHI2_MEDIAN
        if float(square.max()) < _GROSS_SQUARE_RATIO * scale:
            break
        w = np.sqrt(1.0 / (1.0 + square / (9.0 * max(scale, 1e-300)))).repeat(3)
        answer = solve_rows(A * w[:, None], b * w, prior, spread, 0.0)
    return answer


def _median(values: Floats) -> float:
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def robust(square: Floats) -> tuple[Floats, float]:
    """Weights (n,) and robust cost of squared whitened residuals (n,); far off, a sample costs no more and pulls by
    the inverse cube of its distance: at the end of a long lever even a little would be too much."""
    limit = CHI2_999 * max(1.0, _median(square) / CHI2_MEDIAN)
    ratio = limit / np.maximum(square, limit)
    # d² inside, k (2 − k/d²) outside
    return ratio * ratio, float(np.sum(np.where(ratio < 1.0, limit * (2.0 - ratio), square)))


def solve_rows(
    A: Floats, b: Floats, prior: tuple[Floats, Floats], spread: Floats, size: float, *, known: Decision | None = None
) -> tuple[Floats, Floats, Decision]:
    """Least squares `A c = b` by QR; combinations of K that were not observed are held at the value nearest to flat.

    A `known` decision that found everything observed is not taken again; `spread`: of the points, `size`: ‖K‖. Returns
    the parameters (9,), the root (9, 9) of their information, and the decision.
    """
    P, p = prior
    stacked = np.empty((len(A) + 6, 10))
    stacked[:-6, :9], stacked[:-6, 9] = A, b
    stacked[-6:, :9], stacked[-6:, 9] = P, p
    full = upper_root(stacked)
    root, z = full[:9, :9], full[:9, 9]
    if known is not None and known.rank == 3:
        return solved(root, z), root, known
    root_q, has_prior = root[6:, 6:] * C_PER_Q, bool(P[3:].any())
    # rank is the data's: a prior on K itself is left out of it
    data = upper_root(np.concatenate([A, P[:3]])) if has_prior else root
    decision = decide(data[6:, 6:] * C_PER_Q, spread, size)
    if has_prior and decision.rank < 3:
        # what only noise says about the open combinations is taken out, the prior alone speaks there
        V = C_PER_Q[:, None] * decision.vectors[:, decision.passed]
        seen = V @ (decision.vectors[:, decision.passed].T / C_PER_Q)
        hidden = stacked[:-3, 6:9] @ (np.eye(3) - seen)
        mean = p[3:] / np.diag(P[3:, 6:])
        stacked[:-3, 6:9] -= hidden
        stacked[:-3, 9] -= hidden @ mean
        full = upper_root(stacked)
        root, z = full[:9, :9], full[:9, 9]
    if has_prior or decision.rank == 3:
        return solved(root, z), root, decision
    V = decision.vectors[:, decision.passed]
    c = np.empty(9)
    c[6:] = C_PER_Q * (V @ np.linalg.lstsq(root_q @ V, z[6:], rcond=None)[0]) if decision.rank else 0.0
    c[:6] = solved(root[:6, :6], z[:6] - root[:6, 6:] @ c[6:])
    return c, root, decision
