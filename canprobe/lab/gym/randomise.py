"""Values that differ between episodes, by the keys of a scene file, fixed or drawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Values = Mapping[str, Any]
"""Value as in a scene file, or a draw of one, by dotted key."""


@dataclass(frozen=True, slots=True)
class Uniform:
    """A value that is drawn uniformly for each episode.

    Attributes:
        low: least number, or a tuple of them, in the unit of the key.
        high: largest one; tuples are drawn element by element.
    """

    low: float | tuple[float, ...]
    high: float | tuple[float, ...]

    def draw(self, rng: np.random.Generator) -> Any:
        """A number, or a tuple of them."""
        values = rng.uniform(self.low, self.high)
        return values if isinstance(values, float) else tuple(values.tolist())


@dataclass(frozen=True, slots=True)
class OneOf:
    """A value that is one of several, equally likely, for each episode.

    Attributes:
        values: possible values of the key; a value may itself be a draw, or a table with draws in it.
    """

    values: Sequence[Any]

    def draw(self, rng: np.random.Generator) -> Any:
        """Draw one of the values."""
        return drawn(self.values[int(rng.integers(len(self.values)))], rng)


def drawn(value: Any, rng: np.random.Generator) -> Any:
    """The value with all its draws made."""
    if isinstance(value, Uniform | OneOf):
        return value.draw(rng)
    if isinstance(value, Mapping):
        return {key: drawn(item, rng) for key, item in value.items()}
    return value
