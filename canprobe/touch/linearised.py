"""One Gauss–Newton step of the robust nine-parameter fit: what `nonlinear.fit` iterates, for those who cannot wait."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from canprobe.touch._arrays import Array
from canprobe.touch.misfit import term_rows
from canprobe.touch.nonlinear import robust, size_of, solve_rows
from canprobe.touch.quadric import Design, linearise, rows
from canprobe.touch.rank import Decision, spread_of

_SHORTER = (1.0, 0.25)
"""Shares of a step that are tried."""
SETTLED = 0.1
"""Squared length of a step, in standard deviations, below which an answer has settled."""


class Linearised(NamedTuple):
    """A fit at some parameters, and where it points to.

    Attributes:
        c: (9,) parameters.
        cost: robust, with the prior's part and the log-determinant of the noise.
        J: (n, 3, 9) whitened, weighted rows.
        r: (n, 3) their residuals.
        weight: (n,) of the samples.
        target: (9,) solution of the linearised problem.
        root: (9, 9) of its information.
        decision: on the data.
    """

    c: Array
    cost: float
    J: Array
    r: Array
    weight: Array
    target: Array
    root: Array
    decision: Decision

    @property
    def step(self) -> float:
        """Squared length of the way to the target, in standard deviations."""
        way = self.root @ (self.target - self.c)
        return float(way @ way)

    def residuals_at(self, c: Array) -> Array:
        """Minus the residuals (n, 3) at other parameters (9,) nearby."""
        result: Array = -self.r - self.J @ (c - self.c)
        return result


def linearised(c: Array, d: Design, prior: tuple[Array, Array]) -> Linearised:
    """The problem at parameters (9,), solved once.

    Args:
        c: parameters.
        d: constant parts.
        prior: rows (6, 9) and right-hand side (6,).
    """
    r, J, log_det = rows(c, d)
    weight, cost = robust(np.einsum("ij,ij->i", r, r))
    assumed = prior[0] @ c - prior[1]
    cost += log_det + float(assumed @ assumed)
    w = np.sqrt(weight)[:, None]
    r, J = r * w, J * w[:, :, None]
    A = J.reshape(-1, 9)
    target, root, decision = solve_rows(A, A @ c - r.reshape(-1), prior, spread_of(d.X, d.point_variance), size_of(c))
    return Linearised(c, cost, J, r, weight, target, root, decision)


def gauss_newton(now: Linearised, d: Design, prior: tuple[Array, Array]) -> Linearised:
    """The next one at the target, or nearer where the step from there is longer; `now` where that is no better either.

    The length of the next step says whether a step was good, not the cost: the whitening changes with K, so the place
    where the steps end is not quite where the cost is least.

    Source: Deuflhard, "Newton methods for nonlinear problems", 2004 (the natural monotonicity test).
    """
    for share in _SHORTER:
        there = linearised(now.c + share * (now.target - now.c), d, prior)
        if there.step <= max(now.step, SETTLED):
            return there
    return now


def with_terms(now: Linearised, d: Design) -> Array:
    """Rows (n, 3, 18) of the parameters and of the terms that a quadric leaves out (`terms`), weighted alike."""
    E = term_rows(linearise(now.c, d), d) * np.sqrt(now.weight)[:, None, None]
    return np.concatenate([now.J, E], axis=2)
