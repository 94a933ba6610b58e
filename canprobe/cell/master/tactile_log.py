"""The tactile frames of a run, in rows."""

from __future__ import annotations

import math
from dataclasses import astuple
from pathlib import Path

import numpy as np

from canprobe.cell.master.controller import TactileSample
from canprobe.cell.rows import BLOCK_ROWS, LazyColumns, Rows

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
        raw = () if frame.raw is None else (frame.raw,)
        features = _NO_FEATURES if frame.features is None else astuple(frame.features)
        times = t_s, sample.t_sample_ns * 1e-9 + start_s, sample.t_sigma_s
        if self.rows is None:
            of_raw = [("raw", values.dtype, values.shape) for values in raw]
            of_times = [(name, np.float64) for name in ("t_s", "t_sample_s", "t_sigma_s")]
            of_frame = [("taxels", np.uint8, frame.taxels.shape), ("window", np.int64, 4), ("features", np.float64, 7)]
            self.rows = Rows([*of_raw, *of_times, *of_frame], self._file, self._kept)
        self.rows.add(np.array((*raw, *times, frame.taxels, frame.window, features), self.rows.dtype).tobytes())
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
