"""A square-root information filter for the nine-parameter model and the terms that a quadric leaves out.

Samples with weights w leave the variance of `(Σ w)² / Σ w²` samples in full, but count as `Σ w` in the information. A
prior in full would then outweigh them by more than was stated, twice as much after a long path. So the prior is
weighted by `Σ w² / Σ w`, which gives the least mean square error over surfaces that are as the prior says.

Why a root of the information and not the information itself: forming `JᵀJ` squares the condition number, which is
10³ to 10⁵ here. Why information and not a covariance (a Kalman filter): what was not observed has no finite covariance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.estimate.answer import foot
from canprobe.mechanics.touch.estimate.gate import MeasuredContact, noise_of
from canprobe.mechanics.touch.estimate.noise import Correlation, SlowErrors
from canprobe.mechanics.touch.estimate.nonlinear import DIFFUSE_INFORMATION
from canprobe.mechanics.touch.estimate.omitted_terms import OmittedTerms
from canprobe.mechanics.touch.estimate.prior import NUISANCE_SIGMA, Prior
from canprobe.mechanics.touch.estimate.quadric import matrix_of
from canprobe.mechanics.touch.estimate.residuals import Design, design, linearise, transport
from canprobe.mechanics.touch.linear_algebra import inverted, inverted_upper, upper_root
from canprobe.mechanics.touch.tangent_frames import homogeneous, transported
from canprobe.mechanics.types import Floats, Vec


def batch_design(T_base_work: Floats, length: float, touches: Sequence[MeasuredContact]) -> Design:
    """The design (`residuals.design`) of contacts in a working frame (4, 4), in units of a length (m)."""
    R = T_base_work[:3, :3]
    points = (np.array([t.point for t in touches]) - T_base_work[:3, 3]).dot(R) / length
    return design(points, np.array([t.normal for t in touches]).dot(R), noise_of(touches).scaled(length, R))


REANCHOR_TRAVEL_SHARE = 0.05
"""Distance from the origin of the working frame, over the memory, from which on that frame is moved along."""
MAX_GRADIENT_GROWTH = 2.0 * NUISANCE_SIGMA[0]
"""Largest growth of ln |∇f| over a memory that information may rest on: a standard deviation of the weak prior on c13.

|∇f| is 1 − 2 c13 x along a path. In a frame that has moved on it is 1 again, so it is less at the earlier samples, and
their information, which has |∇f|² in its denominator, is more. Where c13 stands for cubic terms of a surface that is no
quadric, the information would grow faster than it fades. What is above the limit is forgotten.
"""


class _Path(NamedTuple):
    """Weight of the path, m: the sums of its pieces' weights and of their squares."""

    weight: float = 0.0
    square: float = 0.0

    @property
    def share(self) -> float:
        """Weight of the prior."""
        return self.square / self.weight if self.weight else 1.0

    def on(self, moved: float, kept: float) -> _Path:
        """The path with a new piece (m), and the weights of the others multiplied by `kept`."""
        return _Path(kept * self.weight + moved, kept**2 * self.square + moved)


class InformationFilter:
    """Parameters with a root of their information in a working frame; new rows are added, and old ones fade.

    Args:
        length: the memory, and the unit of length of the problem, m.
        prior: the prior; its weight falls from 1 at the start to a half after a long path, as that of the samples does.
        correlation: correlation of the rows along the path; it enters the covariance of the answer only.

    Attributes:
        T: (4, 4) working frame to base, m.
        c: (9,) parameters (`quadric`).
        root: (9, 9) root of their information, which is `rootᵀ root`.
        inverse: (9, 9) inverse of `root`.
        omitted: sums for the terms that a quadric leaves out, and for the covariance of the answer.
    """

    def __init__(self, length: float, prior: Prior, correlation: Correlation | None) -> None:
        self.length = length
        self._prior_rows = DIFFUSE_INFORMATION * np.eye(9)  # root of the information without samples
        self._prior_rows[3:6] = prior.rows(length)[0][:3]
        self.omitted = OmittedTerms(self._prior_rows.T @ self._prior_rows, correlation)
        self.begin(np.eye(4))

    def begin(self, T: Floats) -> None:
        """Start from the prior alone: a plane in a frame (4, 4)."""
        self.T = T
        self.c = np.zeros(9)
        self._inflation = 1.0
        self._path = _Path()
        self.root, self.inverse = self._prior_rows, inverted_upper(self._prior_rows)
        self.omitted.reset()

    def adopt(  # noqa: PLR0917 - what a batch solution is
        self,
        T: Floats,
        c: Floats,
        root: Floats,
        rows: Floats,
        residuals: Floats,
        travelled: float,
        slow: SlowErrors | None = None,
    ) -> None:
        """Take over a batch solution.

        Args:
            T: (4, 4) working frame of the solution to base, m.
            c: (9,) parameters.
            root: (9, 9) root of their information.
            rows: (n, 3, 18) whitened and weighted rows, evenly spread over the path.
            residuals: (n, 3) minus their residuals.
            travelled: length of the path, m.
            slow: slow errors of the contacts; None: they have none.
        """
        self.T, self.c = T, c.copy()
        self._inflation = 1.0
        self._path = _Path(travelled, travelled)
        # after a straight start `root` is singular
        self.root = upper_root(np.concatenate([root, DIFFUSE_INFORMATION * np.eye(9)]))
        self.inverse = inverted_upper(self.root)
        self.omitted.start(rows, residuals, travelled, slow)

    def take(self, rows: Floats, residuals: Floats, moved: float, slow: SlowErrors | None = None) -> None:
        """Forget over a step of the path (m), then add weighted rows (n, 3, 18) and minus residuals (n, 3): one QR.

        `slow` are the slow errors of the contacts; None: they have none.
        """
        rows, residuals = rows.reshape(-1, 18), residuals.reshape(-1)
        kept = math.exp(-moved / self.length) / self._inflation
        self._inflation = 1.0
        left = kept * self._path.share
        self._path = self._path.on(moved, kept)
        share = self._path.share
        # share ≥ left: no weight is above 1, so that the sum of squares is at most the sum
        lost = math.sqrt(share - left) * self._prior_rows
        stacked = np.empty((18 + len(rows), 10))
        stacked[:9, :9], stacked[:9, 9] = math.sqrt(kept) * self.root, 0.0
        stacked[9:18, :9], stacked[9:18, 9] = lost, -lost.dot(self.c)  # the prior is about c = 0, the unknown is a step
        stacked[18:, :9], stacked[18:, 9] = rows[:, :9], residuals
        full = upper_root(stacked)
        self.root = full[:9, :9]
        self.inverse = inverted_upper(self.root)
        step = self.inverse.dot(full[:9, 9])
        self.c = self.c + step
        self.omitted.take(rows, residuals, step, moved, kept, share**2 - left**2, slow)

    def equations(self, touches: Sequence[MeasuredContact]) -> tuple[Floats, Floats]:
        """Whitened rows (n, 3, 18) and minus residuals (n, 3) of new contacts, as `take` wants them."""
        at = linearise(self.c, batch_design(self.T, self.length, touches))
        return at.jacobian(18), -at.r

    def squared_innovations(self, rows: Floats, residuals: Floats) -> Floats:
        """(n,) squared innovations of such contacts, χ² of 3."""
        variance = 1.0 + np.square(rows[:, :, :9] @ self.inverse).sum(axis=2)
        result: Floats = (np.square(residuals) / variance).sum(axis=1)
        return result

    def place(self, point: Floats) -> Vec:
        """A point (3,) of base in the working frame, dimensionless."""
        x, y, z = (point - self.T[:3, 3]).dot(self.T[:3, :3]).tolist()
        return x / self.length, y / self.length, z / self.length

    def follow(self, point: Floats) -> None:
        """Move to a contact frame at the foot of a point (3,) of base, once that is far enough from the working frame.

        The information is carried along with the frame (`transport`), so nothing is forgotten by it, unless |∇f| grows
        faster than `MAX_GRADIENT_GROWTH` allows.
        """
        near = u, v, w = self.place(point)
        if u * u + v * v + w * w < REANCHOR_TRAVEL_SHARE**2:
            return
        x, z_axis = foot(self.c, near)
        turned = np.array((*transported((1.0, 0.0, 0.0), z_axis), z_axis)).T
        gradient = 2.0 * matrix_of(self.c).dot((*x, 1.0))[:3]
        allowed = math.exp(2.0 * MAX_GRADIENT_GROWTH * math.hypot(u, v, w))
        self._inflation *= max(1.0, float(gradient.dot(gradient)) / allowed)
        self.c, M = transport(self.c, homogeneous(turned, x))
        self.c[:3] = 0.0
        back = inverted(M)
        self.root, self.inverse = self.root.dot(back), M.dot(self.inverse)
        self.omitted.carry(back, x[0], x[1])
        R = self.T[:3, :3]
        self.T = homogeneous(R.dot(turned), self.T[:3, 3] + self.length * R.dot(x))
