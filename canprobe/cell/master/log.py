"""The rows of a run: one a cycle, and one a tactile frame that the cell used."""

from __future__ import annotations

import math
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, MutableSequence, Sequence
from copy import copy
from dataclasses import astuple
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.rows import BLOCK_ROWS, NUMBER, ROWS_SUFFIX, LazyColumns, Rows
from canprobe.mechanics.types import Floats

_NO_NUMBERS = (TypeError, ValueError, OverflowError)
_Part = tuple[NDArray[np.int64], Mapping[str, Sequence[Any] | Floats]]
"""Numbers of rows in the log, and the values of each column there."""


class _RowKind:
    """Rows with the same names: how their values lie in one block of float64, as the first whole row has them.

    Args:
        names: names of the columns, in order.
        file: file of the rows; None keeps them in memory.
        kept: number of rows that are kept; None for all.

    Attributes:
        odd: rows with a value that is no number or has another shape, with their number in the log; in memory.
    """

    def __init__(self, names: tuple[str, ...], file: Path | None, kept: int | None) -> None:
        self.names = names
        self.odd: MutableSequence[tuple[int, tuple[Any, ...]]] = [] if kept is None else deque(maxlen=kept)
        self.rows: Rows | None = None
        self._file, self._kept = file, kept
        self._block = np.empty(0)
        self._views: list[Floats] = []

    def add(self, number: int, values: Iterable[Any]) -> None:
        """Append a row with its number in the log; nothing in it changes with the arrays that were given."""
        try:
            if self.rows is None:
                self._lay_out([np.asarray(value) for value in values])
            for view, value in zip(self._views, values, strict=True):
                view[...] = value
        except _NO_NUMBERS:
            self.odd.append((number, tuple(copy(value) for value in values)))
            return
        assert self.rows is not None
        self._block[0] = number
        self.rows.add(self._block.tobytes())

    def _lay_out(self, values: Sequence[NDArray[Any]]) -> None:
        if any(value.dtype.kind not in "biuf" for value in values):
            raise TypeError("a value that is no number")
        fields = [(name, np.float64, value.shape) for name, value in zip(self.names, values, strict=True)]
        self.rows = Rows([(NUMBER, np.float64), *fields], self._file, self._kept)
        self._block = np.empty(1 + sum(value.size for value in values))
        start = 1
        for value in values:
            self._views.append(self._block[start : start + value.size].reshape(value.shape))
            start += value.size

    def stored(self, first: int) -> Iterator[_Part]:
        """The rows from the row `first` of the log on, in blocks."""
        for block in self.rows.blocks() if self.rows is not None else ():
            numbers = block[NUMBER].astype(np.int64)
            start = int(np.searchsorted(numbers, first))
            if start < len(numbers):
                yield numbers[start:], {name: block[name][start:] for name in self.names}

    def single(self, first: int) -> Iterator[_Part]:
        """The odd rows from the row `first` on, without values that are None."""
        for number, values in self.odd:
            if number >= first:
                known = zip(self.names, values, strict=True)
                yield np.array([number]), {name: [value] for name, value in known if value is not None}

    def has_rows(self, first: int) -> bool:
        """Whether there are rows from the row `first` on."""
        return any(True for _ in self.stored(first)) or any(number >= first for number, _ in self.odd)


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

    def __len__(self) -> int:
        return self._added if self._kept is None else min(self._added, self._kept)

    def add(self, row: dict[str, object]) -> None:
        """Append one row."""
        names = tuple(row)
        kind = self._kinds.get(names)
        if kind is None:
            file = self._folder / f"log-{len(self._kinds)}{ROWS_SUFFIX}" if self._folder is not None else None
            kind = self._kinds[names] = _RowKind(names, file, self._kept)
        kind.add(self._added, row.values())
        self._added += 1
        if self._folder is not None and self._added % BLOCK_ROWS == 0:
            self.flush()

    @property
    def _stored(self) -> list[Rows]:
        return [kind.rows for kind in self._kinds.values() if kind.rows is not None]

    def flush(self) -> None:
        """Write the rows that wait."""
        for rows in self._stored:
            rows.flush()

    @property
    def failure(self) -> str | None:
        """Why rows are no longer written; None while they are."""
        return next((rows.failure for rows in self._stored if rows.failure is not None), None)

    def remove(self) -> None:
        """Remove the files of the rows; they are in ``log.npz`` by now."""
        for rows in self._stored:
            rows.remove()

    def columns(self) -> LazyColumns:
        """Every column that the rows have, (n,) or (n, k); without a row ``t_s`` alone.

        A value of another shape than its column's first, or none, is NaN, with a warning: one must not cost the others.
        """
        first = self._added - len(self)
        names = dict.fromkeys(name for kind in self._kinds.values() if kind.has_rows(first) for name in kind.names)
        return LazyColumns(tuple(names or ("t_s",)), partial(self._make, first))

    def arrays(self) -> dict[str, Floats]:
        """The columns in memory, with ``t_s`` since the first SYNC."""
        columns = dict(self.columns())
        return columns | {"t_s": since_first_sync(columns["t_s"], self.start_s)} if "t_s" in columns else columns

    def _make(self, first: int, names: Sequence[str]) -> dict[str, Floats]:
        """Columns of the rows from the row `first` on, in one pass."""
        made = {name: np.full((len(self), *self._shape(name, first)), np.nan) for name in names}
        misfits: Counter[str] = Counter()
        for numbers, part in (part for way in self._ways(*names) for part in way(first)):
            for name in made.keys() & part.keys():
                out, values = made[name], part[name]
                if isinstance(values, np.ndarray) and values.shape[1:] == out.shape[1:]:
                    out[numbers - first] = values
                    continue
                for i, value in zip(numbers - first, values, strict=True):
                    try:
                        out[i] = value
                    except _NO_NUMBERS:
                        misfits[name] += 1
        for name, count in misfits.items():
            wanted = f"numbers of shape {made[name].shape[1:]}, as its first is"
            warnings.warn(f"log: {count} values of column {name!r} are no {wanted}: left NaN", stacklevel=3)
        return made

    def _ways(self, *names: str) -> list[Callable[[int], Iterator[_Part]]]:
        """Iterators over the rows of kinds that have some of these columns."""
        kinds = [kind for kind in self._kinds.values() if not set(names).isdisjoint(kind.names)]
        return [way for kind in kinds for way in (kind.stored, kind.single)]

    def _shape(self, name: str, first: int) -> tuple[int, ...]:
        """Shape of a column's values; the first of all decides it."""
        ways = self._ways(name)
        heads = [next(((n[0], part[name][0]) for n, part in way(first) if name in part), None) for way in ways]
        known = [head for head in heads if head is not None]
        try:
            return np.shape(min(known, key=itemgetter(0))[1]) if known else ()
        except ValueError:  # rows of unequal length
            return ()


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
