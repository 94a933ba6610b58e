"""The middle of the sandwich covariance: how noise gets through weighted and forgotten rows into an answer.

An answer `c = A⁻¹ Jᵀ W e` has the covariance `A⁻¹ (Jᵀ W R W J) A⁻¹`. Why not `A⁻¹`, as for plain least squares:
forgetting weighs rows without making them noisier, so weights enter squared, and correlated rows add what they share.

Source: Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 1967; White 1980.
"""

from __future__ import annotations

import math

import numpy as np

from canprobe.mechanics.touch.estimate.noise import Correlation, SlowErrors, mixed
from canprobe.mechanics.types import Floats

_TILTS = np.array([[0.0], [1.0], [1.0]])
"""Rows of a contact that a slow error of its centroid changes: both tilts, not the height."""


class Score:
    """Covariance `matrix` (k, k) of the score `Jᵀ W e` of a filter that forgets along the path.

    Args:
        prior: (k, k) information of the prior about the k parameters.
        correlation: correlation of the rows along the path; None for independent samples.
    """

    def __init__(self, prior: Floats, correlation: Correlation | None) -> None:
        self._prior = prior
        self._correlation = correlation
        self._shares = np.zeros((3, 1)) if correlation is None else np.sqrt(correlation.shares)[:, None]
        self.reset()

    def reset(self) -> None:
        """Forget all rows; the prior stays."""
        self.matrix = self._prior.copy()
        self._recent, self._slow = np.zeros((3, len(self.matrix))), np.zeros((3, len(self.matrix)))
        self._way = 0.0

    def start(self, J: Floats, travelled: float, slow: SlowErrors | None = None) -> None:
        """Take a batch's whitened rows (n, 3, k), evenly spread over a path (m), all in full."""
        self.reset()
        k = len(self.matrix)
        rows = J.reshape(-1, k)
        if self._correlation is None:
            self.matrix += rows.T @ rows
            return
        places = np.linspace(0.0, travelled, len(J))
        self.matrix += rows.T @ mixed(self._correlation.matrix(places, slow), J).reshape(-1, k)
        fades = np.exp((places - travelled) / self._correlation.length)
        self._recent = (fades[:, None, None] * self._correlated(len(J), slow) * J).sum(axis=0)
        if slow is not None:
            self._way = float(slow.way[-1])
            fades = slow.share * np.exp((slow.way - self._way) / self._correlation.pad_length)
            self._slow = _TILTS * (fades @ J.reshape(-1, 3 * k)).reshape(3, k)

    def take(self, J: Floats, moved: float, kept: float, known: float, slow: SlowErrors | None = None) -> None:
        """Take new whitened rows (3n, k) of a step of the path.

        Args:
            J: the rows.
            moved: length of the step, m.
            kept: share of the earlier information that the step leaves.
            known: share of the prior that is put back into the matrix.
            slow: slow errors of the contacts; None: they have none.
        """
        self.matrix = kept**2 * self.matrix + known * self._prior + self._added(J, moved, kept, slow)

    def carry(self, back: Floats) -> None:
        """Change to other parameters; back (k, k) is d(old)/d(new)."""
        self.matrix = back.T.dot(self.matrix).dot(back)
        self._recent, self._slow = self._recent.dot(back), self._slow.dot(back)

    def _correlated(self, n: int, slow: SlowErrors | None) -> Floats:
        """(n, 3, 1) standard deviations, over those of the rows, of what is correlated along the path."""
        rest = np.ones(n) if slow is None else slow.rest
        return self._shares * (1.0 - _TILTS * (1.0 - rest[:, None, None]))

    def _added(self, J: Floats, moved: float, kept: float, slow: SlowErrors | None) -> Floats:
        """(k, k) that new rows add: by themselves, and with earlier rows with which they are correlated."""
        if self._correlation is None:
            return np.asarray(J.T.dot(J), dtype=np.float64)
        n, k = len(J) // 3, J.shape[1]
        fade = math.exp(-moved / (n * self._correlation.length))
        each, correlated = J.reshape(n, 3, k), self._correlated(n, slow)
        # exp(−s / length) makes the sum over all earlier rows a recursion with one row: no path has to be kept
        recent, past = kept * self._recent, np.empty((n, 3, k))
        for i in range(n):
            recent *= fade
            past[i] = correlated[i] * recent
            recent += correlated[i] * each[i]
        self._recent = recent
        if slow is not None:
            self._slow *= kept
            for i, (share, way) in enumerate(zip(slow.share.tolist(), slow.way.tolist(), strict=True)):
                self._slow *= math.exp((self._way - way) / self._correlation.pad_length)
                past[i] += share * self._slow
                self._slow += share * (_TILTS * each[i])
                self._way = way
        cross = J.T.dot(past.reshape(-1, k))
        return np.asarray(J.T.dot(J) + cross + cross.T, dtype=np.float64)
