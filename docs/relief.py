"""The heights of the packaged scene `relief`: `python docs/relief.py` writes them anew, the same ones each time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SPACING_MM = 0.5
SEED = 26
FILE = Path(__file__).parent.parent / "canprobe" / "scenes" / "relief.npz"


def relief_mm() -> NDArray[np.float32]:
    """Heights over 64 mm (rows, x) by 40 mm (columns, y): a free form with a groove and an edge, mm."""
    x, y = np.meshgrid(np.arange(-32, 32.1, SPACING_MM), np.arange(-20, 20.1, SPACING_MM), indexing="ij")
    z = -(x**2) / (2 * 90) - y**2 / (2 * 60)
    waves = np.random.default_rng(SEED).uniform((0.1, -0.2, 0.0, 0.02), (0.2, 0.2, 6.3, 0.06), (4, 4))
    for kx, ky, phase, size in waves:
        z += size * np.cos(kx * x + ky * y + phase)
    z -= 0.4 * np.exp(-(((x - 0.2 * y - 7.0) / 0.8) ** 4))  # a groove 1.6 mm wide and 0.4 mm deep
    over = -(x + 0.3 * y + 8.0)  # behind this line the surface falls off by another 8 degrees
    z -= np.tan(np.radians(8.0)) * 0.5 * (over + np.hypot(over, 0.5))
    return z.astype(np.float32)


if __name__ == "__main__":
    np.savez_compressed(FILE, heights=relief_mm(), spacing=SPACING_MM)
