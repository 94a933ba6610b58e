"""Names of types that all of mechanics shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""An array of numbers; its shape and unit stand in the docstring of what takes or returns it."""
Vec = tuple[float, float, float]
"""A vector in plain floats, for what runs in every cycle."""
