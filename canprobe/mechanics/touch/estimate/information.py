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
from canprobe.mechanics.touch.estimate.noise import Correlation, Noise, Prior, mixed
from canprobe.mechanics.touch.estimate.nonlinear import DIFFUSE, Averaged, averaged, scales
from canprobe.mechanics.touch.estimate.quadric import Design, design, linearise, sharpest, shifted, size_of, transport
from canprobe.mechanics.touch.linear_algebra import (
    Array,
    Vec,
    eigen,
    homogeneous,
    inverted,
    inverted_upper,
    solved,
    transported,
    upper_root,
)


class Touch(NamedTuple):
    """What a contact gives the filter: place (3,) m and outward unit normal (3,) in base, and their noise.

    The noise is in m, rad and, what couples them (`Noise.coupling`), 1/m.
    """

    point: Array
    normal: Array
    sigma_point: float
    sigma_normal: float
    coupling: float = 0.0


def batch_design(T_base_work: Array, length: float, touches: Sequence[Touch]) -> Design:
    """Contacts (`quadric.design`) in a working frame (4, 4), in units of a length (m)."""
    R = T_base_work[:3, :3]
    points = (np.array([t.point for t in touches]) - T_base_work[:3, 3]).dot(R) / length
    sigma_point = np.array([t.sigma_point for t in touches]) / length
    noise = Noise(sigma_point, np.array([t.sigma_normal for t in touches]), touches[0].coupling * length)
    return design(points, np.array([t.normal for t in touches]).dot(R), noise)


# What the noise of weighted and forgotten rows does to an answer: the middle of the sandwich covariance.
#
# An answer `c = A⁻¹ Jᵀ W e` has the covariance `A⁻¹ (Jᵀ W R W J) A⁻¹`, not `A⁻¹`: forgetting weighs rows without making
# them noisier, so weights enter squared, and correlated rows add what they share.
#
# Source: Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 1967; White 1980.


class Score:
    """Covariance `matrix` (k, k) of the score `Jᵀ W e` of a filter that forgets along the path.

    Args:
        prior: (k, k) information of what is always known about the k parameters.
        correlation: of the rows along the path; None for independent samples.
    """

    def __init__(self, prior: Array, correlation: Correlation | None) -> None:
        self._prior = prior
        self._correlation = correlation
        self._shares = np.zeros((3, 1)) if correlation is None else correlation.shares[:, None]
        self.reset()

    def reset(self) -> None:
        """Only the prior is left."""
        self.matrix = self._prior.copy()
        self._recent = np.zeros((3, len(self.matrix)))

    def start(self, J: Array, travelled: float) -> None:
        """Take a batch's whitened rows (n, 3, k), evenly spread over a path (m), which all count in full."""
        self.reset()
        k = len(self.matrix)
        rows = J.reshape(-1, k)
        if self._correlation is None:
            self.matrix += rows.T @ rows
            return
        places = np.linspace(0.0, travelled, len(J))
        self.matrix += rows.T @ mixed(self._correlation.matrix(places), J).reshape(-1, k)
        fades = np.exp((places - travelled) / self._correlation.length)
        self._recent = self._shares * (fades @ J.reshape(-1, 3 * k)).reshape(3, k)

    def take(self, J: Array, moved: float, kept: float, known: float) -> None:
        """Take new whitened rows (3n, k) over a step (m) of the path, which leaves `kept` of the information.

        `known` is what of the prior is put back into the matrix, over the whole prior.
        """
        self.matrix = kept**2 * self.matrix + known * self._prior + self._added(J, moved, kept)

    def carry(self, back: Array) -> None:
        """Go over to other parameters; back (k, k) is d(old)/d(new)."""
        self.matrix = back.T.dot(self.matrix).dot(back)
        self._recent = self._recent.dot(back)

    def _added(self, J: Array, moved: float, kept: float) -> Array:
        """What new rows add: with each other, and with earlier ones that they resemble."""
        if self._correlation is None:
            return np.asarray(J.T.dot(J), dtype=np.float64)
        n, k = len(J) // 3, J.shape[1]
        fade = math.exp(-moved / (n * self._correlation.length))
        shared = self._shares * J.reshape(n, 3, k)
        recent, past = kept * self._recent, np.empty((n, 3, k))
        for i in range(n):
            recent *= fade
            past[i] = recent
            recent += shared[i]
        self._recent = recent
        cross = J.T.dot(past.reshape(-1, k))
        return np.asarray(J.T.dot(J) + cross + cross.T, dtype=np.float64)


# What a filter knows about the terms that a quadric leaves out, in constant time and memory.
#
# The filter fits a quadric. Beside it, its samples' rows of the cubic and quartic terms are summed with those of its
# parameters, forgotten alike and carried from frame to frame: as much as `nonlinear` needs of a batch. The terms are
# what the samples say at terms of zero; they are never put into the filter, only into its answers.

_REGULAR = 1e-9
"""What keeps the covariance of the terms' score regular, over its mean."""


class Amended(NamedTuple):
    """An answer of a filter, averaged over what its quadric leaves out; misfit, trusted: as of `nonlinear.Averaged`.

    The covariance (9, 9) is what the terms add to that of the noise; symmetric, not definite by itself.
    """

    c: Array
    covariance: Array
    misfit: float
    trusted: bool


class Expected(NamedTuple):
    """What is known beforehand of what a filter is given.

    Attributes:
        noise: variance of the residuals over what is stated. Generous deviations make a misfit look like noise.
        curvature: least ‖K‖ · length whose usual changes are reckoned with: a flat place need not lie on a plane.
        sigma_point: stated standard deviation of a point over the length.
    """

    noise: float = 1.0
    curvature: float = 0.0
    sigma_point: float = 0.0


class _Along(NamedTuple):
    """The average over the terms, in directions in which what the samples say about them is independent.

    Attributes:
        found: the average.
        off: (9, 9) what a unit along each direction does to the parameters.
        terms: (9, 9) the terms of such a unit.
        shared: (18, 9) covariance of the score with that of the terms.
        weighted: (9, 9) weights of what the samples say.
    """

    found: Averaged
    off: Array
    terms: Array
    shared: Array
    weighted: Array


class LeftOut:
    """Sums over the rows of parameters and terms; `score` is that of both.

    Args:
        prior, correlation: as of `Score`, for the nine parameters.
    """

    def __init__(self, prior: Array, correlation: Correlation | None) -> None:
        wide = np.zeros((18, 18))
        wide[:9, :9] = prior
        self.score = Score(wide, correlation)
        self.reset()

    def reset(self) -> None:
        """No samples."""
        self.score.reset()
        self._information = np.zeros((18, 18))
        self._slope = np.zeros(9)

    def start(self, rows: Array, residuals: Array, travelled: float) -> None:
        """Take a batch's rows (n, 3, 18) and minus residuals (n, 3), evenly spread over a path (m)."""
        self.score.start(rows, travelled)
        flat = rows.reshape(-1, 18)
        self._information = flat.T @ flat
        self._slope = flat[:, 9:].T @ residuals.reshape(-1)

    def take(  # noqa: PLR0917 - as `Score.take`, and what the sums need
        self, rows: Array, residuals: Array, step: Array, moved: float, kept: float, known: float
    ) -> None:
        """Take new rows (3n, 18), minus their residuals (3n,) before the parameters made a step (9,)."""
        self.score.take(rows, moved, kept, known)
        self._information = kept * self._information + rows.T.dot(rows)
        self._slope = kept * self._slope + rows[:, 9:].T.dot(residuals) - self._information[9:, :9].dot(step)

    def carry(self, back: Array, x: float, y: float) -> None:
        """Go over to a frame at (x, y); back (9, 9) is d(old)/d(new) of the parameters."""
        A, Q = shifted(x, y)
        away = 2.0 * np.eye(9) - A  # its inverse: a quartic term leaves cubic ones behind, a cubic one none
        wide = np.zeros((18, 18))
        wide[:9, :9], wide[:9, 9:], wide[9:, 9:] = back, -back.dot(Q).dot(away), away
        self.score.carry(wide)
        self._information = wide.T.dot(self._information).dot(wide)
        self._slope = away.T.dot(self._slope)

    def amend(self, c: Array, H: Array, place: Vec, expected: Expected) -> Amended:
        """Average an answer at a place over the terms; c (9,) of the filter, H (9, 9) the inverse of its
        information.
        """
        a = self._along(c, H, expected, place)
        both = H.dot(a.shared[:9]).dot(a.weighted * a.found.share).dot(a.off.T)
        return Amended(c + a.found.shift, a.found.spread + both + both.T, a.found.misfit, a.found.trusted)

    def explanation(self, c: Array, H: Array, expected: Expected) -> Array:
        """What the terms most likely are: (18,) what they add to the filter's parameters, and the terms."""
        a = self._along(c, H, expected, (0.0, 0.0, 0.0))
        return np.concatenate([a.found.shift, a.terms @ a.found.terms])

    def _along(self, c: Array, H: Array, expected: Expected, place: Vec) -> _Along:
        curvature = max(size_of(c), expected.curvature)
        D = scales(curvature)
        X = np.zeros((18, 9))  # what a unit of each term does to the parameters, and the term itself
        X[:9] = H.dot(self._information[:9, 9:]) * -D
        X[9:].flat[::10] = D
        shared = self.score.matrix.dot(X)
        V = X.T.dot(shared)  # of y = m a + noise, all that the samples say about the terms
        V.flat[::10] += _REGULAR * V.trace()
        m = D[:, None] * self._information[9:].dot(X)
        weighted = solved(V, m)
        values, U = eigen(m.dot(weighted))
        information = np.maximum(values, 0.0) / expected.noise
        s = U.T.dot(weighted.T.dot(D * self._slope)) / expected.noise
        blur = sharpest(c) * expected.sigma_point * math.sqrt(expected.noise)
        off, terms = X[:9].dot(U), D[:, None] * U
        off[6:] += shifted(place[0], place[1])[1][6:].dot(terms)
        found = averaged(information, s, -off, curvature, blur)
        return _Along(found, off, terms, shared, weighted.dot(U))


# The filter, and how it is carried from frame to frame.

ANCHOR = 0.05
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
        self.root: Array
        self.inverse: Array
        self._prior_rows = _prior_rows(prior, length)
        self.left_out = LeftOut(self._prior_rows.T @ self._prior_rows, correlation)
        self.begin(np.eye(4))

    def begin(self, T: Array) -> None:
        """Know nothing but the prior: a plane in a frame (4, 4)."""
        self.T = T
        self.c = np.zeros(9)
        self._path = _Path()
        self._set_root(self._prior_rows)
        self.left_out.reset()

    def adopt(  # noqa: PLR0917 - what a batch solution is
        self, T: Array, c: Array, root: Array, rows: Array, residuals: Array, travelled: float
    ) -> None:
        """Take over a batch solution: its working frame (4, 4), parameters (9,), root (9, 9) of their information,
        whitened and weighted rows (n, 3, 18), and minus their residuals (n, 3), evenly spread over the path (m).
        """
        self.T, self.c = T, c.copy()
        self._path = _Path(travelled, travelled)
        self._set_root(upper_root(np.concatenate([root, DIFFUSE * np.eye(9)])))
        self.left_out.start(rows, residuals, travelled)

    def take(self, rows: Array, residuals: Array, moved: float) -> None:
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

    def equations(self, touches: Sequence[Touch]) -> tuple[Array, Array]:
        """Whitened rows (n, 3, 18) and minus residuals (n, 3) of new contacts, as `take` wants them."""
        at = linearise(self.c, batch_design(self.T, self.length, touches))
        return at.jacobian(18), -at.r

    def squared_innovations(self, rows: Array, residuals: Array) -> Array:
        """(n,) squared innovations of such contacts, χ² of 3."""
        variance = 1.0 + np.square(rows[:, :, :9] @ self.inverse).sum(axis=2)
        result: Array = (np.square(residuals) / variance).sum(axis=1)
        return result

    def place(self, point: Array) -> Vec:
        """A point (3,) of base in the working frame, dimensionless."""
        x, y, z = (point - self.T[:3, 3]).dot(self.T[:3, :3]).tolist()
        return x / self.length, y / self.length, z / self.length

    def follow(self, point: Array) -> None:
        """Carry everything to a contact frame at the foot of a point (3,) of base, once that is far enough away."""
        near = u, v, w = self.place(point)
        if u * u + v * v + w * w < ANCHOR**2:
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

    def _set_root(self, root: Array) -> None:
        """Take an upper triangular root."""
        self.root, self.inverse = root, inverted_upper(root)


def _prior_rows(prior: Prior, length: float) -> Array:
    """(9, 9) root of what is always known."""
    own = DIFFUSE * np.eye(9)
    own[3:6] = prior.rows(length)[0][:3]
    return own
