"""The run's log: a row a cycle and a row a tactile frame, in memory; and the notes of what went wrong."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Iterable, MutableSequence, Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.types import Floats

_NO_NUMBERS = (TypeError, ValueError, OverflowError)
_Part = tuple[list[int], Sequence[Any] | Floats]
"""Rows of a column and their values."""


class _RowKind:
    """Rows with the same names: how their values lie in one block of float64, as the first whole row has them.

    Args:
        names: names of the columns, in order.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names
        self._block = np.empty(0)
        self._views: list[Floats] = []

    def packed(self, values: Iterable[Any]) -> bytes | tuple[Any, ...]:
        """A copy of a row's values: one block, or a tuple where one of them is no number or has another shape."""
        try:
            if not self._views:
                self._lay_out([np.asarray(value) for value in values])
            for view, value in zip(self._views, values, strict=True):
                view[...] = value
        except _NO_NUMBERS:
            return tuple(copy(value) for value in values)
        return self._block.tobytes()

    @property
    def width(self) -> int:
        """Count of numbers in a block."""
        return len(self._block)

    def column(self, name: str, blocks: Floats) -> Floats:
        """The values (n, ...) of a name in blocks (n, width)."""
        place = self.names.index(name)
        start, shape = sum(view.size for view in self._views[:place]), self._views[place].shape
        return blocks[:, start : start + self._views[place].size].reshape(len(blocks), *shape)

    def _lay_out(self, values: Sequence[NDArray[Any]]) -> None:
        if any(value.dtype.kind not in "biuf" for value in values):
            return
        self._block = np.empty(sum(value.size for value in values))
        start = 0
        for value in values:
            self._views.append(self._block[start : start + value.size].reshape(value.shape))
            start += value.size


class RunLog:
    """Collects named columns row by row; a column that a row lacks is filled with NaN there.

    Column names carry their unit as a suffix (``t_s``, ``q_rad``, ``force_n``). Values are numbers or small vectors.
    A row is kept as one block of numbers: sorting its values into columns would cost ten times as much in the cycle,
    keeping them as they come four times the memory. Nothing in it changes with the arrays that were given.

    Args:
        kept: how many rows are kept, the last ones: a cell that is left running for days must not grow; None for all.
    """

    def __init__(self, kept: int | None = None) -> None:
        self._rows: MutableSequence[tuple[_RowKind, bytes | tuple[Any, ...]]]
        self._rows = [] if kept is None else deque(maxlen=kept)
        self._kinds: dict[tuple[str, ...], _RowKind] = {}

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: dict[str, object]) -> None:
        """Append one row."""
        names = tuple(row)
        kind = self._kinds.get(names)
        if kind is None:
            kind = self._kinds[names] = _RowKind(names)
        self._rows.append((kind, kind.packed(row.values())))

    def arrays(self) -> dict[str, Floats]:
        """Every column that the rows have, (n,) or (n, k).

        A value of another shape than its column's first, or none, is NaN, with a warning: one must not cost the others.
        """
        kinds = dict.fromkeys(kind for kind, _ in self._rows)
        columns: dict[str, list[_Part]] = {name: [] for kind in kinds for name in kind.names}
        blocks: dict[_RowKind, tuple[list[int], list[bytes]]] = {}
        for i, (kind, values) in enumerate(self._rows):
            if isinstance(values, bytes):
                rows, packed = blocks.setdefault(kind, ([], []))
                rows.append(i)
                packed.append(values)
            else:
                for name, value in zip(kind.names, values, strict=True):
                    if value is not None:
                        columns[name].append(([i], [value]))
        for kind, (rows, packed) in blocks.items():
            table = np.frombuffer(b"".join(packed)).reshape(len(rows), kind.width)
            for name in kind.names:
                columns[name].append((rows, kind.column(name, table)))
        return {name: self._column(name, parts) for name, parts in columns.items()}

    def _column(self, name: str, parts: list[_Part]) -> Floats:
        """A column of its parts; the first value of all decides the shape."""
        parts = sorted(parts, key=lambda part: part[0][0])
        try:
            shape = np.shape(parts[0][1][0]) if parts else ()
        except ValueError:  # rows of unequal length
            shape = ()
        out = np.full((len(self._rows), *shape), np.nan)
        misfits = 0
        for rows, values in parts:
            if isinstance(values, np.ndarray) and values.shape[1:] == shape:
                out[rows] = values
                continue
            for i, value in zip(rows, values, strict=True):
                try:
                    out[i] = value
                except _NO_NUMBERS:
                    misfits += 1
        if misfits:
            text = (
                f"log: {misfits} values of column {name!r} are no numbers of shape {shape}, as its first is: left NaN"
            )
            warnings.warn(text, stacklevel=3)
        return out
