"""One Gauss–Newton step of the robust fit that `nonlinear.fit` iterates, for a loop with bounded work per call."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.estimate.nonlinear import robust, solve_rows
from canprobe.mechanics.touch.estimate.observed import Decision, spread_of
from canprobe.mechanics.touch.estimate.quadric import size_of
from canprobe.mechanics.touch.estimate.residuals import Design, linearise
from canprobe.mechanics.types import Floats

_STEP_SHARES = (1.0, 0.25)
"""Shares of a step that are tried, in this order."""
SETTLED_STEP = 0.1
"""Largest squared length of a step, in standard deviations, of an answer that has settled."""


class Solved(NamedTuple):
    """The problem at some parameters, solved once.

    Attributes:
        c: (9,) parameters.
        cost: robust cost, with the prior's part and the log-determinant of the noise.
        rows: (n, 3, 18) whitened and weighted rows of the parameters and of the terms that a quadric leaves out.
        r: (n, 3) their residuals.
        weight: (n,) weights of the samples.
        target: (9,) solution of the linearised problem.
        root: (9, 9) root of its information.
        decision: rank decision on the data.
    """

    c: Floats
    cost: float
    rows: Floats
    r: Floats
    weight: Floats
    target: Floats
    root: Floats
    decision: Decision

    @property
    def step(self) -> float:
        """Squared length of the way to the target, in standard deviations."""
        way = self.root @ (self.target - self.c)
        return float(way @ way)

    def residuals_at(self, c: Floats) -> Floats:
        """Minus the residuals (n, 3) at other parameters (9,) nearby."""
        result: Floats = -self.r - self.rows[:, :, :9] @ (c - self.c)
        return result


def solved_once(c: Floats, d: Design, prior: tuple[Floats, Floats]) -> Solved:
    """The problem at parameters (9,); prior: rows (6, 9) and right-hand side (6,)."""
    at = linearise(c, d)
    weight, cost = robust(np.einsum("ij,ij->i", at.r, at.r))
    assumed = prior[0] @ c - prior[1]
    cost += at.log_det + float(assumed @ assumed)
    w = np.sqrt(weight)[:, None]
    r, rows = at.r * w, at.jacobian(18) * w[:, :, None]
    A = rows[:, :, :9].reshape(-1, 9)
    target, root, decision = solve_rows(A, A @ c - r.reshape(-1), prior, spread_of(d.X, d.point_variance), size_of(c))
    return Solved(c, cost, rows, r, weight, target, root, decision)


def gauss_newton(now: Solved, d: Design, prior: tuple[Floats, Floats]) -> Solved:
    """The problem solved at the target, or at a quarter of the way; `now` where both are worse.

    A step is worse if the next step from there is longer. Why not compare costs: the whitening changes with K, so the
    place where the steps end is not quite where the cost is least.

    Source: Deuflhard, "Newton methods for nonlinear problems", 2004 (the natural monotonicity test).
    """
    for share in _STEP_SHARES:
        there = solved_once(now.c + share * (now.target - now.c), d, prior)
        if there.step <= max(now.step, SETTLED_STEP):
            return there
    return now
