"""The run's log: one row a cycle in memory, columns with units as arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class RunLog:
    """Collects named columns row by row; a column that starts late is filled with NaN before.

    Column names carry their unit as a suffix (``t_s``, ``q_deg``, ``force_n``). Values are numbers or small vectors.
    """

    def __init__(self) -> None:
        self._columns: dict[str, list[object]] = {}
        self._first: dict[str, int] = {}
        self._rows = 0

    def __len__(self) -> int:
        return self._rows

    def add(self, row: dict[str, object]) -> None:
        """Append one row; names missing in it are filled with NaN."""
        columns = self._columns
        for name, value in row.items():
            column = columns.get(name)
            if column is None:
                column = columns[name] = []
                self._first[name] = self._rows
            missing = self._rows - self._first[name] - len(column)
            if missing:
                column.extend([None] * missing)
            column.append(value)
        self._rows += 1

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Every column as an array of the log's length, (n,) or (n, k)."""
        return {name: self._array(name) for name in self._columns}

    def _array(self, name: str) -> NDArray[np.float64]:
        column = self._columns[name]
        known = (np.asarray(value).shape for value in column if value is not None)
        out = np.full((self._rows, *next(known, ())), np.nan)
        first = self._first[name]
        for i, value in enumerate(column):
            if value is not None:
                out[first + i] = value
        return out
