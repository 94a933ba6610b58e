"""The run's log: one row a cycle in memory, columns with units as arrays; all of them, or the last ones."""

from __future__ import annotations

from collections import deque
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class CycleLog(Protocol):
    """What a cell writes its rows to."""

    def __len__(self) -> int:
        """Rows that are there."""

    def add(self, row: dict[str, object]) -> None:
        """Append one row."""

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Every column, (n,) or (n, k)."""


class LastRows:
    """Keeps the last rows only: a cell that is left running for days must not grow.

    Args:
        rows: how many.
    """

    def __init__(self, rows: int) -> None:
        self._rows: deque[dict[str, object]] = deque(maxlen=rows)

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: dict[str, object]) -> None:
        """Append one row; the oldest goes."""
        self._rows.append(row)

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Every column that the kept rows have, (n,) or (n, k)."""
        log = RunLog()
        for row in self._rows:
            log.add(row)
        return log.arrays()


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
