"""Names of types that all of mechanics shares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
"""Array of numbers; the docstring of a function or field gives its shape and unit."""
Vec = tuple[float, float, float]
"""Vector in plain floats, for code that runs in every cycle."""
