"""A square-root information filter for the nine-parameter model and the terms that a quadric leaves out.

Forgetting makes samples count for less than they know: with weights w they leave the variance that `(Σ w)² / Σ w²` of
them would in full, and count for `Σ w`. A prior in full would outweigh them by more than was stated, twice as much
after a long path. So it counts by `Σ w² / Σ w`: the least mean square of the errors, over surfaces as it says they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.estimate.answer import foot
from canprobe.mechanics.touch.estimate.noise import Correlation, Noise
from canprobe.mechanics.touch.estimate.nonlinear import DIFFUSE_INFORMATION
from canprobe.mechanics.touch.estimate.omitted_terms import OmittedTerms
from canprobe.mechanics.touch.estimate.prior import Prior
from canprobe.mechanics.touch.estimate.residuals import Design, design, linearise, transport
from canprobe.mechanics.touch.linear_algebra import inverted, inverted_upper, upper_root
from canprobe.mechanics.touch.tangent_frames import homogeneous, transported
from canprobe.mechanics.types import Floats, Vec


class MeasuredContact(NamedTuple):
    """What a contact gives the filter: place (3,) m and outward unit normal (3,) in base, and their noise.

    The noise is in m, rad and, what couples them (`Noise.coupling`), 1/m.
    """

    point: Floats
    normal: Floats
    sigma_point: float
    sigma_normal: float
    coupling: float = 0.0


def batch_design(T_base_work: Floats, length: float, touches: Sequence[MeasuredContact]) -> Design:
    """Contacts (`quadric.design`) in a working frame (4, 4), in units of a length (m)."""
    R = T_base_work[:3, :3]
    points = (np.array([t.point for t in touches]) - T_base_work[:3, 3]).dot(R) / length
    sigma_point = np.array([t.sigma_point for t in touches]) / length
    noise = Noise(sigma_point, np.array([t.sigma_normal for t in touches]), touches[0].coupling * length)
    return design(points, np.array([t.normal for t in touches]).dot(R), noise)


REANCHOR_TRAVEL_SHARE = 0.05
"""Travel between two changes of the working frame over the memory."""


class _Path(NamedTuple):
    """What the path counts for, m: the sums of its pieces' weights and of their squares."""

    weight: float = 0.0
    square: float = 0.0

    @property
    def share(self) -> float:
        """By how much the prior counts."""
        return self.square / self.weight if self.weight else 1.0

    def on(self, moved: float, kept: float) -> _Path:
        """With a new piece (m), after which the others count `kept` times what they did."""
        return _Path(kept * self.weight + moved, kept**2 * self.square + moved)


class InformationFilter:
    """Parameters with a root of their information in a working frame; rows come in, old ones fade.

    Args:
        length: the memory, and the unit of length of the problem, m.
        prior: counts as the samples do, which are new and in full at first and faded to a half after a long path.
        correlation: of the rows along the path; only the covariance of the answer knows of it.

    Attributes:
        T: (4, 4) working frame to base, m.
        c: (9,) parameters (`quadric`).
        root: (9, 9) `rootᵀ root` is their information.
        inverse: (9, 9) of `root`.
        left_out: what the rows say about the terms that a quadric has not, and what their noise does.
    """

    def __init__(self, length: float, prior: Prior, correlation: Correlation | None) -> None:
        self.length = length
        self.root: Floats
        self.inverse: Floats
        self._prior_rows = _prior_rows(prior, length)
        self.left_out = OmittedTerms(self._prior_rows.T @ self._prior_rows, correlation)
        self.begin(np.eye(4))

    def begin(self, T: Floats) -> None:
        """Know nothing but the prior: a plane in a frame (4, 4)."""
        self.T = T
        self.c = np.zeros(9)
        self._path = _Path()
        self._set_root(self._prior_rows)
        self.left_out.reset()

    def adopt(  # noqa: PLR0917 - what a batch solution is
        self, T: Floats, c: Floats, root: Floats, rows: Floats, residuals: Floats, travelled: float
    ) -> None:
        """Take over a batch solution: its working frame (4, 4), parameters (9,), root (9, 9) of their information,
        whitened and weighted rows (n, 3, 18), and minus their residuals (n, 3), evenly spread over the path (m).
        """
        self.T, self.c = T, c.copy()
        self._path = _Path(travelled, travelled)
        self._set_root(upper_root(np.concatenate([root, DIFFUSE_INFORMATION * np.eye(9)])))
        self.left_out.start(rows, residuals, travelled)

    def take(self, rows: Floats, residuals: Floats, moved: float) -> None:
        """Forget over a step of the path (m), then take in weighted rows (n, 3, 18), minus residuals (n, 3): one QR."""
        rows, residuals = rows.reshape(-1, 18), residuals.reshape(-1)
        kept = math.exp(-moved / self.length)
        left = kept * self._path.share
        self._path = self._path.on(moved, kept)
        share = self._path.share
        lost = math.sqrt(share - left) * self._prior_rows
        stacked = np.empty((18 + len(rows), 10))
        stacked[:9, :9], stacked[:9, 9] = math.sqrt(kept) * self.root, 0.0
        stacked[9:18, :9], stacked[9:18, 9] = lost, -lost.dot(self.c)
        stacked[18:, :9], stacked[18:, 9] = rows[:, :9], residuals
        full = upper_root(stacked)
        self._set_root(full[:9, :9])
        step = self.inverse.dot(full[:9, 9])
        self.c = self.c + step
        self.left_out.take(rows, residuals, step, moved, kept, share**2 - left**2)

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
        """Carry everything to a contact frame at the foot of a point (3,) of base, once that is far enough away."""
        near = u, v, w = self.place(point)
        if u * u + v * v + w * w < REANCHOR_TRAVEL_SHARE**2:
            return
        x, z_axis = foot(self.c, near)
        turned = np.array((*transported((1.0, 0.0, 0.0), z_axis), z_axis)).T
        self.c, M = transport(self.c, homogeneous(turned, x))
        self.c[:3] = 0.0
        back = inverted(M)
        self.root, self.inverse = self.root.dot(back), M.dot(self.inverse)
        self.left_out.carry(back, x[0], x[1])
        R = self.T[:3, :3]
        self.T = homogeneous(R.dot(turned), self.T[:3, 3] + self.length * R.dot(x))

    def _set_root(self, root: Floats) -> None:
        """Take an upper triangular root."""
        self.root, self.inverse = root, inverted_upper(root)


def _prior_rows(prior: Prior, length: float) -> Floats:
    """(9, 9) root of what is always known."""
    own = DIFFUSE_INFORMATION * np.eye(9)
    own[3:6] = prior.rows(length)[0][:3]
    return own
