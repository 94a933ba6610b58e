"""Bit errors on the wire of a timed bus. A model is asked once for each transmission; one seed gives the same bits."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

WireErrors = Callable[[int, bytes, int], int | None]
"""Called with (can_id, data, bits) of a frame that starts; returns the bit that is hit, counted from 0, or None."""


class BitErrors:
    """Errors of bits that fail independently of each other, each with the same probability.

    Args:
        rate: bit error rate, 0..1; 1e-7 in an industrial hall, 3e-5 next to a welder (Ferreira et al. 2004).
        seed: seed of the sequence.
    """

    def __init__(self, rate: float, seed: int) -> None:
        if not 0 <= rate < 1:
            raise ValueError(f"a bit error rate lies in 0..1, not {rate}")
        self._log = math.log1p(-rate)
        self._random = random.Random(seed)
        self._left = self._gap()

    def __call__(self, can_id: int, data: bytes, bits: int) -> int | None:
        """Number of the first bit of this frame that is hit, or None."""
        if self._left >= bits:
            self._left -= bits
            return None
        hit, self._left = int(self._left), self._gap()
        return hit

    def _gap(self) -> float:
        """Number of good bits before the next bad one."""
        return math.floor(math.log(1.0 - self._random.random()) / self._log) if self._log else math.inf
