"""What the noise of weighted and forgotten rows does to an answer: the middle of the sandwich covariance.

An answer `c = A⁻¹ Jᵀ W e` has the covariance `A⁻¹ (Jᵀ W R W J) A⁻¹`, not `A⁻¹`: forgetting weighs rows without making
them noisier, so weights enter squared, and correlated rows add what they share.

Source: Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 1967; White 1980.
"""

from __future__ import annotations

import numpy as np

from canprobe.touch._arrays import Array
from canprobe.touch.noise import Correlation, mixed


class Score:
    """Covariance of the score `Jᵀ W e` of a filter that forgets along the path.

    Args:
        prior: (9, 9) information of what is always known.
        correlation: of the rows along the path; None for independent samples.

    Attributes:
        matrix: (9, 9).
    """

    def __init__(self, prior: Array, correlation: Correlation | None) -> None:
        self._prior = prior
        self._correlation = correlation
        self.reset()

    def reset(self) -> None:
        """Only the prior is left."""
        self.matrix = self._prior.copy()
        self._recent = np.zeros((3, 9))

    def start(self, root: Array, J: Array, travelled: float) -> None:
        """Take a batch solution whose rows all count in full.

        Args:
            root: (9, 9) of its information.
            J: (n, 3, 9) its whitened rows, evenly spread over the path.
            travelled: length of the path, m.
        """
        self.matrix = root.T @ root
        self._recent = np.zeros((3, 9))
        if self._correlation is None:
            return
        places = np.linspace(0.0, travelled, len(J))
        self.matrix = self._prior + J.reshape(-1, 9).T @ mixed(self._correlation.matrix(places), J).reshape(-1, 9)
        fades = np.exp((places - travelled) / self._correlation.length)
        self._recent = self._correlation.shares[:, None] * (fades @ J.reshape(-1, 27)).reshape(3, 9)

    def take(self, J: Array, moved: float, kept: float) -> None:
        """Take new whitened rows (3n, 9) over a step of the path (m); `kept` is what it leaves of the information."""
        self.matrix = kept**2 * self.matrix + (1.0 - kept**2) * self._prior + self._added(J, moved, kept)

    def carry(self, back: Array) -> None:
        """Go over to other parameters; back (9, 9) is d(old)/d(new)."""
        self.matrix = back.T @ self.matrix @ back
        self._recent = self._recent @ back

    def _added(self, J: Array, moved: float, kept: float) -> Array:
        """What new rows add: with each other, and with earlier ones that they resemble."""
        if self._correlation is None:
            return np.asarray(J.T @ J, dtype=np.float64)
        n = len(J) // 3
        places = moved / n * np.arange(1.0, n + 1.0)
        by_sample = J.reshape(n, 27)
        own = J.T @ mixed(self._correlation.matrix(places), J.reshape(n, 3, 9)).reshape(-1, 9)
        fades = np.exp(-places / self._correlation.length)
        cross = (fades @ by_sample).reshape(3, 9).T @ (kept * self._recent)
        newest = self._correlation.shares[:, None] * ((fades[-1] / fades) @ by_sample).reshape(3, 9)
        self._recent = kept * fades[-1] * self._recent + newest
        return np.asarray(own + cross + cross.T, dtype=np.float64)
