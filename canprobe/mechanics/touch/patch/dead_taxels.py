"""Dead taxels: found where a taxel reads nothing inside a patch, and bridged by their neighbours.

A dead taxel inside a patch at 2 N moves the centroid by up to a tenth of a pitch and lowers the force by some percent.
At the rim it cannot be distinguished from the end of the patch, and hardly matters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

MIN_COUNTS = 20
"""Least count of each of the four neighbours: more than the pressure of a patch can fall from one taxel to the next."""
_LEVELS = bytes((count > 0) + (count >= MIN_COUNTS) for count in range(256))
_GAP = bytes((2, 0, 2))
"""A dead taxel between its left and its right neighbour, in levels of counts."""
Image = NDArray[np.uint8]


def mended(taxels: Image) -> tuple[Image, int]:
    """The image with its dead taxels bridged, and their number.

    The same array (rows, columns) is returned where none is dead; else a copy in which each dead taxel has the mean of
    its four neighbours.
    """
    if not may_be_dead(taxels.tobytes()):
        return taxels, 0
    inner = taxels[1:-1, 1:-1]
    sides = (taxels[:-2, 1:-1], taxels[2:, 1:-1], taxels[1:-1, :-2], taxels[1:-1, 2:])
    least = np.minimum(np.minimum(sides[0], sides[1]), np.minimum(sides[2], sides[3]))
    dead = least > (MIN_COUNTS - 1) + 255 * (inner > 0).astype(np.int16)
    n = int(np.count_nonzero(dead))
    if n == 0:
        return taxels, 0
    mean = np.mean(np.stack([s.astype(np.float64) for s in sides]), axis=0)
    whole = taxels.copy()
    whole[1:-1, 1:-1][dead] = np.rint(mean[dead]).astype(np.uint8)
    return whole, n


def may_be_dead(counts: bytes) -> bool:
    """Whether a taxel reads nothing between two pressed ones; a quick test before the whole search, mostly False."""
    return _GAP in counts.translate(_LEVELS)
