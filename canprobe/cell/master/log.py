"""The rows of a run: one a cycle, and one a tactile frame that the cell used."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.rows import BLOCK_ROWS, NUMBER, ROWS_SUFFIX, LazyColumns, Rows
from canprobe.mechanics.types import Floats

_NO_NUMBERS = (TypeError, ValueError, OverflowError)


class _RowKind:
    """Rows with the same names, each of them one block of float64.

    Args:
        shapes: shape of each column, by its name.
        file: file of the rows; None keeps them in memory.
        kept: number of rows that are kept; None for all.

    Attributes:
        last: number of its last row in the log.
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], file: Path | None, kept: int | None) -> None:
        self.names = tuple(shapes)
        self.last = -1
        self.rows = Rows([(NUMBER, np.float64), *((name, np.float64, shapes[name]) for name in shapes)], file, kept)
        ends = np.cumsum([1, *map(math.prod, shapes.values())])
        self._block = np.empty(ends[-1])
        parts = zip(ends, ends[1:], shapes.values(), strict=False)
        self._views = [self._block[start:end].reshape(shape) for start, end, shape in parts]

    def add(self, number: int, values: Iterable[Any]) -> bool:
        """Append a row with its number in the log, unless a value does not fit; it keeps nothing of given arrays."""
        try:
            for view, value in zip(self._views, values, strict=True):
                view[...] = value
        except _NO_NUMBERS:
            return False
        self._block[0] = self.last = number
        self.rows.add(self._block.tobytes())
        return True


def since_first_sync(t_s: Floats, start_s: float) -> Floats:
    """Times on the run's clock, s, as times since the first SYNC at `start_s`, equal to the cell's to the last bit."""
    return np.asarray(np.round((t_s - start_s) * 1e9).astype(np.int64) * 1e-9)


class RunLog:
    """Collects named columns row by row; a column that a row lacks is filled with NaN there.

    Column names carry their unit as a suffix (``t_s``, ``q_rad``, ``force_n``). Values are numbers or small vectors.
    A row is kept as one block of numbers: sorting its values into columns would cost ten times as much in the cycle,
    keeping them as they come four times the memory.

    Args:
        kept: how many rows are kept, the last ones: a cell that is left running for days must not grow; None for all.
        folder: folder for the rows, in a file for each kind of row (``log-0.npy.gz``); None keeps them in memory.

    Attributes:
        start_s: time of the first SYNC on the clock of the rows.
    """

    def __init__(self, kept: int | None = None, folder: Path | None = None) -> None:
        self._kept = kept
        self._folder = folder
        self.start_s = 0.0
        self._added = 0
        self._kinds: dict[tuple[str, ...], _RowKind] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._unknown: dict[str, int] = {}  # columns without a number so far, with the last row that has them
        self._misfits: Counter[str] = Counter()

    def __len__(self) -> int:
        return self._added if self._kept is None else min(self._added, self._kept)

    def add(self, row: dict[str, object]) -> None:
        """Append one row."""
        kind = self._kinds.get(tuple(row))
        if kind is None or not kind.add(self._added, row.values()):
            values = self._fitting(row)
            names = tuple(values)
            if names not in self._kinds:
                file = self._folder / f"log-{len(self._kinds)}{ROWS_SUFFIX}" if self._folder is not None else None
                self._kinds[names] = _RowKind({name: self._shapes[name] for name in names}, file, self._kept)
            self._kinds[names].add(self._added, values.values())
        self._added += 1
        if self._folder is not None and self._added % BLOCK_ROWS == 0:
            self.flush()

    def _fitting(self, row: dict[str, object]) -> dict[str, NDArray[Any]]:
        """The row as its columns take it. The first number of a column decides its shape; what does not fit is NaN."""
        fitting = {}
        for name, value in row.items():
            try:
                number = np.asarray(value)
            except _NO_NUMBERS:  # rows of unequal length
                number = np.asarray(None)
            if number.dtype.kind in "biuf" and number.shape == self._shapes.setdefault(name, number.shape):
                fitting[name] = number
                continue
            self._misfits[name] += value is not None
            if name in self._shapes:
                fitting[name] = np.full(self._shapes[name], np.nan)
            else:
                self._unknown[name] = self._added
        return fitting

    def flush(self) -> None:
        """Write the rows that wait."""
        for kind in self._kinds.values():
            kind.rows.flush()

    @property
    def failure(self) -> str | None:
        """Why rows are no longer written; None while they are."""
        return next((kind.rows.failure for kind in self._kinds.values() if kind.rows.failure is not None), None)

    def remove(self) -> None:
        """Remove the files of the rows; they are in ``log.npz`` by now."""
        for kind in self._kinds.values():
            kind.rows.remove()

    def columns(self) -> LazyColumns:
        """Every column that the rows have, (n,) or (n, k); without a row ``t_s`` alone.

        A value of another shape than its column's first, or none, is NaN, with a warning: one must not cost the others.
        """
        first = self._added - len(self)
        names = dict.fromkeys(name for kind in self._kinds.values() if kind.last >= first for name in kind.names)
        names.update(dict.fromkeys(name for name, last in self._unknown.items() if last >= first))
        return LazyColumns(tuple(names or ("t_s",)), partial(self._make, first))

    def arrays(self) -> dict[str, Floats]:
        """The columns in memory, with ``t_s`` since the first SYNC."""
        columns = dict(self.columns())
        return columns | {"t_s": since_first_sync(columns["t_s"], self.start_s)} if "t_s" in columns else columns

    def _make(self, first: int, names: Sequence[str]) -> dict[str, Floats]:
        """Columns of the rows from the row `first` on, in one pass."""
        made = {name: np.full((len(self), *self._shapes.get(name, ())), np.nan) for name in names}
        for kind in self._kinds.values():
            held = made.keys() & kind.names
            for block in kind.rows.blocks() if held else ():
                start = int(np.searchsorted(block[NUMBER], first))
                places = block[NUMBER][start:].astype(np.int64) - first
                for name in held:
                    made[name][places] = block[name][start:]
        for name in names:
            if count := self._misfits[name]:
                wanted = f"numbers of shape {made[name].shape[1:]}, as its first is"
                warnings.warn(f"log: {count} values of column {name!r} are no {wanted}: left NaN", stacklevel=3)
        return made


_NO_FEATURES = (math.nan,) * 7


class TactileLog:
    """The tactile frames that the cell used: images and what belongs to them, for `tactile.npz`.

    Args:
        kept: how many frames are kept, the last ones; None for all.
        folder: folder for their file, ``tactile.npy.gz``; None keeps them in memory.
    """

    def __init__(self, kept: int | None = None, folder: Path | None = None) -> None:
        self.rows: Rows | None = None
        self._kept = kept
        self._file = folder / f"tactile{ROWS_SUFFIX}" if folder is not None else None

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

    def flush(self) -> None:
        """Write the frames that wait."""
        if self.rows is not None:
            self.rows.flush()

    def columns(self) -> LazyColumns:
        """A row for each frame (m, ...): when it was usable and sampled, s, taxels, their window, features."""
        return LazyColumns((), lambda _: {}) if self.rows is None else self.rows.columns()

    def remove(self) -> None:
        """Remove the file; its rows are in ``tactile.npz`` by now."""
        if self.rows is not None:
            self.rows.remove()
