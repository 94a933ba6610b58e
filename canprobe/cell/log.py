"""The run's log: one row a cycle in memory, columns with units as arrays; all of them, or the last ones."""

from __future__ import annotations

from collections import deque
from collections.abc import MutableSequence

import numpy as np
from numpy.typing import NDArray


class RunLog:
    """Collects named columns row by row; a column that a row lacks is filled with NaN there.

    Column names carry their unit as a suffix (``t_s``, ``q_deg``, ``force_n``). Values are numbers or small vectors.
    A row is kept as it comes: in the cycle that costs a tenth of sorting its values into columns.

    Args:
        kept: how many rows are kept, the last ones: a cell that is left running for days must not grow; None for all.
    """

    def __init__(self, kept: int | None = None) -> None:
        self._rows: MutableSequence[tuple[tuple[str, ...], tuple[object, ...]]]
        self._rows = [] if kept is None else deque(maxlen=kept)
        self._names: dict[tuple[str, ...], tuple[str, ...]] = {}  # each set of names once

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: dict[str, object]) -> None:
        """Append one row."""
        names = tuple(row)
        self._rows.append((self._names.setdefault(names, names), tuple(row.values())))

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Every column that the rows have, (n,) or (n, k)."""
        columns: dict[str, dict[int, object]] = {}
        for i, (names, values) in enumerate(self._rows):
            for name, value in zip(names, values, strict=True):
                columns.setdefault(name, {})[i] = value
        return {name: self._array(column) for name, column in columns.items()}

    def _array(self, column: dict[int, object]) -> NDArray[np.float64]:
        known = {i: value for i, value in column.items() if value is not None}
        shape = np.asarray(next(iter(known.values()))).shape if known else ()
        out = np.full((len(self._rows), *shape), np.nan)
        for i, value in known.items():
            out[i] = value
        return out
