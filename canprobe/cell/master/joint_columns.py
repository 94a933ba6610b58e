"""Positions of joints: columns `q_rad` for those that turn, `q_m` for those that slide, one place a joint in each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import astuple
from pathlib import Path
from struct import pack

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.controller import TactileSample
from canprobe.cell.rows import BLOCK_ROWS, LazyColumns, Rows
from canprobe.mechanics.types import Floats


def joint_columns(name: str, q: Floats, prismatic: NDArray[np.bool_] | None) -> dict[str, Floats]:
    """Joint positions as columns of the log: of an arm whose joints all turn `name_rad` alone, else with `name_m`.

    Args:
        name: `q` or `q_target`.
        q: (n,) rad or m.
        prismatic: (n,) which joints slide; None: none of them.

    Returns:
        (n,) each, NaN where a joint is of the other kind.
    """
    if prismatic is None:
        return {f"{name}_rad": q}
    sliding = {f"{name}_m": np.where(prismatic, q, np.nan)}
    return sliding if prismatic.all() else {f"{name}_rad": np.where(prismatic, np.nan, q), **sliding}


def joint_positions(log: Mapping[str, Floats], name: str = "q") -> Floats | None:
    """The inverse of `joint_columns` for a whole log: (rows, n) rad or m; None where it has no such columns.

    Args:
        log: columns by name.
        name: `q` or `q_target`.
    """
    turning, sliding = log.get(f"{name}_rad"), log.get(f"{name}_m")
    if turning is None or sliding is None:
        return sliding if turning is None else turning
    return np.where(np.isnan(turning), sliding, turning)


_NO_FEATURES = (math.nan,) * 7


class TactileLog:
    """The tactile frames that the cell used: images and what belongs to them, for `tactile.npz`.

    Args:
        kept: how many frames are kept, the last ones; None for all.
        folder: folder for their file, ``tactile.npy``; None keeps them in memory.
    """

    def __init__(self, kept: int | None = None, folder: Path | None = None) -> None:
        self.rows: Rows | None = None
        self._kept = kept
        self._file = folder / "tactile.npy" if folder is not None else None
        self._added = 0

    def add(self, t_s: float, start_s: float, sample: TactileSample) -> None:
        """Append the sample that became usable in the cycle at ``t_s``, on the run's clock; 0 of its own is `start_s`.

        A device of raw frames has their values besides; features are NaN in a frame of taxels.
        """
        frame = sample.frame
        if self.rows is None:
            raw = [] if frame.raw is None else [("raw", frame.raw.dtype, frame.raw.shape)]
            times = [(name, np.float64) for name in ("t_s", "t_sample_s", "t_sigma_s")]
            of_frame = [("taxels", np.uint8, frame.taxels.shape), ("window", np.int64, 4), ("features", np.float64, 7)]
            self.rows = Rows([*raw, *times, *of_frame], self._file, self._kept)
        features = _NO_FEATURES if frame.features is None else astuple(frame.features)
        self.rows.add(
            (b"" if frame.raw is None else frame.raw.tobytes())
            + pack("=3d", t_s, sample.t_sample_ns * 1e-9 + start_s, sample.t_sigma_s)
            + frame.taxels.tobytes()
            + pack("=4q7d", *frame.window, *features)
        )
        self._added += 1
        if self._file is not None and self._added % BLOCK_ROWS == 0:
            self.rows.flush()

    def columns(self) -> LazyColumns:
        """A row for each frame (m, ...): when it was usable and sampled, s, taxels, their window, features."""
        return LazyColumns({}) if self.rows is None else self.rows.columns()

    def remove(self) -> None:
        """Remove the file; its rows are in ``tactile.npz`` by now."""
        if self.rows is not None:
            self.rows.remove()
