"""Batch Gauss–Newton on the local model, robust.

Points have errors as normals do, so the residuals are whitened by `σ_n² I + K² σ_p²`: this keeps the fit at the
Cramér–Rao bound also on tight curvature. Samples beyond the 99.9 % point of χ² with three degrees of freedom lose
weight (`robust`); where the median residual is larger than expected, the limit grows with it.

Why not a library's least squares: the whitening depends on K, combinations that were not observed are held, and both
are decided anew in every iteration (`solve_rows`).
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
"""Root of the information that keeps a root regular, in units of the length: c known to ±100, K to ±200 over length."""
_STEP_TOLERANCE = 3e-8
_MAX_ITERATIONS = 40
_MAX_START_ROUNDS = 8
_MAX_COST_RISE_SHARE = 0.05
"""Largest relative rise of the cost in one step. Steps end where the residuals balance, which is not quite where the
cost is least, since the whitening changes with K and wrong samples pull."""
_START_PRIOR_NARROWING = 10.0
"""Factor by which the linear start narrows the prior on c13, c23, c33."""
_GROSS_SQUARE_RATIO = 60.0
"""Largest squared residual, over its scale, up to which the linear start is not made robust."""


class QuadricFit(NamedTuple):
    """A converged batch fit in its working frame, dimensionless.

    Attributes:
        c: (9,) parameters.
        root: (9, 9) upper triangular information root, prior included.
        decision: rank decision on the data.
        free: (9,) parameters with no combination held.
        free_root: (9, 9) root of their information, kept regular by `DIFFUSE_INFORMATION`.
        innovation: weighted χ² per degree of freedom.
        outliers: number of samples with less than full weight.
        converged: whether the last step was below the tolerance.
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

    `independent` (3, n, n) makes correlated whitened samples independent (`Correlation.whitener`); None where they are
    independent.
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
        # The prior's part belongs to the cost: without it a large c33 on a short path, which flattens f/|∇f|, would
        # look good. The noise's log-determinant does not: with the feet as unknowns it is no part of the likelihood,
        # and on tight curvature it would draw K down by a tenth.
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
            # steps keep a rank of 3 (`known`); whether the data bear it out is asked here, at the end
            final = solve_rows(A, b, prior, spread, size_of(c))
            if final[2].rank == decision.rank:
                c, root, decision = final
                converged = True
                break
            decision = final[2]
    c = c if converged else best
    has_prior = bool(prior[0][3:].any())
    free, free_root = c, root
    if not has_prior:  # one more step with nothing held
        free_root = upper_root(np.concatenate([root, DIFFUSE_INFORMATION * np.eye(9)]))
        gradient = A.T @ residuals + prior[0].T @ (prior[0] @ best - prior[1])
        free = best - solved(free_root, solved(free_root.T, gradient))
    freedom = max(3 * len(square) - 6 - decision.rank, 1)
    return QuadricFit(c, root, decision, free, free_root, chi2 / freedom, int(np.sum(weight < 1.0)), converged)


def linear_start(
    d: Design, prior: tuple[Floats, Floats], spread: Floats, weight: Floats | None = None
) -> tuple[Floats, Floats, Decision]:
    """The linear solution, as of `solve_rows`; where samples are far off it is repeated with weights.

    Args:
        d: the samples.
        prior: as for `fit`.
        spread: (2, 2) spread of the points (`spread_of`).
        weight: (n,) weights at first; all 1 by default.
    """
    A, b = linear_rows(d)
    # the points' noise in x z, y z and z² would draw c13, c23, c33 so far off that the iteration could not return
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
    # np.median takes 15 µs for 160 values, this takes 3; of an even number it gives the upper one of the two
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def robust(square: Floats) -> tuple[Floats, float]:
    """Weights (n,) and robust cost of squared whitened residuals (n,).

    Beyond the limit the cost hardly grows, and the pull of a sample falls with the cube of its distance. Why not
    Huber's cost, with a constant pull: a wrong sample at the end of the path has a long lever, and even a small pull
    there is too much.
    """
    limit = CHI2_999 * max(1.0, _median(square) / CHI2_MEDIAN)
    ratio = limit / np.maximum(square, limit)
    # d² inside, k (2 − k/d²) outside
    return ratio * ratio, float(np.sum(np.where(ratio < 1.0, limit * (2.0 - ratio), square)))


def solve_rows(
    A: Floats, b: Floats, prior: tuple[Floats, Floats], spread: Floats, size: float, *, known: Decision | None = None
) -> tuple[Floats, Floats, Decision]:
    """Least squares `A c = b` by QR; combinations of K that were not observed are held at the value nearest to flat.

    Args:
        A, b: (3n, 9) rows and (3n,) right-hand side.
        prior: rows (6, 9) and right-hand side (6,), of `Prior.rows`.
        spread: (2, 2) spread of the points (`spread_of`).
        size: ‖K‖, dimensionless.
        known: an earlier decision; one that found all observed is not taken again.

    Returns:
        Parameters (9,), the root (9, 9) of their information, and the decision.
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
    # the rank is that of the data: a prior on K itself is left out of the decision
    data = upper_root(np.concatenate([A, P[:3]])) if has_prior else root
    decision = decide(data[6:, 6:] * C_PER_Q, spread, size)
    if has_prior and decision.rank < 3:
        # the data's part about unobserved combinations is only noise: it is taken out, and the prior alone counts there
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
