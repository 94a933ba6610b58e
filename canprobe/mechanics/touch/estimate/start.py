"""The first stretch of a filter: all its contacts are solved together, by one Gauss–Newton step for each step of path.

A filter that begins linearised on a plane would be off by the tilt of a curved surface along the first stretch, and
would keep that error. So the contacts of the first stretch are kept and solved together. The solution is never iterated
to convergence: each call takes one step from the last answer on the data so far, which bounds the work of every call
(the real-time iteration of model predictive control). By the end of the stretch it is steady.

Source: Diehl, Bock and Schlöder, "A real-time iteration scheme for nonlinear optimization in optimal feedback
control", 2005.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.estimate.estimator import Steps
from canprobe.mechanics.touch.estimate.gate import MeasuredContact, slow_errors
from canprobe.mechanics.touch.estimate.information import batch_design
from canprobe.mechanics.touch.estimate.noise import SlowErrors
from canprobe.mechanics.touch.estimate.nonlinear import linear_start, robust, solve_rows
from canprobe.mechanics.touch.estimate.observed import MIN_SPREAD, Decision, spread_of
from canprobe.mechanics.touch.estimate.prior import Prior
from canprobe.mechanics.touch.estimate.quadric import size_of
from canprobe.mechanics.touch.estimate.residuals import Design, linearise
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation
from canprobe.mechanics.types import Floats

FIRST_SOLUTION_SHARE = 0.1
"""Travel, over the memory, at the first solution."""
TAKEOVER_SHARE = 0.4
"""Travel, over the memory, from which on the filter takes over once the solution is steady."""
LATEST_TAKEOVER_SHARE = 0.8
"""Travel, over the memory, at which it takes over even if the solution still moves."""
MAX_CONTACTS = 128
"""Most contacts that are kept; when there are more, every second one is dropped."""
_FRAME_CONTACTS = 5
"""Number of contacts whose median place and normal make the working frame: medians, as one may be wrong."""
_STEP_SHARES = (1.0, 0.25)
"""Shares of a step that are tried, in this order."""
STEADY_STEP = 0.1
"""Largest squared length of a step, in standard deviations, of a steady answer."""


class Start:
    """Contacts of the first stretch and their solution so far, for a filter with a memory of `length` (m).

    Attributes:
        T: (4, 4) working frame of the solution to base, m.
        solution: the solution so far; None before the first.
        slow: slow errors of the contacts of the solution.
        steady: whether the last step was small, and all of K was observed or the stretch is over.
        travelled: path so far, m.
    """

    def __init__(self, length: float, prior: Prior) -> None:
        self.T = np.eye(4)
        self.solution: Solved | None = None
        self.slow: SlowErrors | None = None
        self.steady = False
        self.travelled = 0.0
        self._length = length
        self._prior = prior.rows(length)
        self._touches: list[MeasuredContact] = []

    @property
    def over(self) -> bool:
        """Whether the filter should take over."""
        share = self.travelled / self._length
        return self.solution is not None and (
            share >= LATEST_TAKEOVER_SHARE or (share >= TAKEOVER_SHARE and self.steady)
        )

    def adding(self, touches: Sequence[MeasuredContact], moved: float) -> Steps[None]:
        """Take in the contacts of a step of the path (m), and improve the solution by a Gauss–Newton step."""
        self._touches += touches
        if len(self._touches) > MAX_CONTACTS:
            # why not the oldest: the stretch is solved as a whole, and contacts at its begin have the longest lever
            self._touches = self._touches[::2]
        self.travelled += moved
        share = self.travelled / self._length
        if share < FIRST_SOLUTION_SHARE:
            return
        if self.solution is None:
            last = self._touches[-_FRAME_CONTACTS:]
            normal = np.median([t.normal for t in last], axis=0)
            normal = normal / np.sqrt(normal @ normal)
            self.T = homogeneous(tangent_rotation(-normal), np.median([t.point for t in last], axis=0))
        d = batch_design(self.T, self._length, self._touches)
        if share < TAKEOVER_SHARE and float(np.linalg.eigvalsh(spread_of(d.X, d.point_variance))[0]) < MIN_SPREAD:
            return
        yield from self._improve(d, share >= TAKEOVER_SHARE)

    def _improve(self, d: Design, stretch_over: bool) -> Steps[None]:
        """Take a step from the last solution or, until that is steady, from a linear one where that costs less."""
        now = None if self.solution is None else solved_once(self.solution.target, d, self._prior)
        if now is None or not self.steady:
            spread = spread_of(d.X, d.point_variance)
            plain = linear_start(d, self._prior, spread, isolation(d.X, d.point_variance))[0]
            fresh = solved_once(plain, d, self._prior)
            now = fresh if now is None or fresh.cost < now.cost else now
        yield
        better = gauss_newton(now, d, self._prior)
        self.solution, self.slow = better, slow_errors(self._touches)
        # while a combination is held at flat steps are small, too: only the end of the stretch makes that steady
        known = self.steady or better.decision.rank == 3 or stretch_over
        self.steady = known and better.step < STEADY_STEP


def isolation(points: Floats, variance: Floats) -> Floats:
    """Weights (n,) of points (n, 3) along a path: far below 1 for a single point far from its neighbours.

    A point is compared with the median of the five about it. Its squared distance is measured by the median of all, or
    by the variance (n,) of the points' noise per axis where that is larger.
    """
    if len(points) < 5:
        return np.ones(len(points))
    # mirrored without the end itself: with the end repeated it would be the median of its own window, and a last point
    # that is 5 mm wrong would keep its full weight instead of 3e-4
    padded = np.concatenate([points[1:3][::-1], points, points[-3:-1][::-1]])
    windows = np.stack([padded[k : k + len(points)] for k in range(5)])
    off = points - np.median(windows, axis=0)
    square = np.einsum("ij,ij->i", off, off)
    usual = 9.0 * np.maximum(float(np.median(square)), variance)
    result: Floats = usual / np.maximum(square, usual)
    return result


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
        return -self.r - self.rows[:, :, :9] @ (c - self.c)


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
        if there.step <= max(now.step, STEADY_STEP):
            return there
    return now
