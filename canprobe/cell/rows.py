"""Rows of a run while it goes on: in memory, or in blocks in an ``.npy`` file that `numpy.load` reads at any moment.

A run of an hour has 1.4 million cycles. Its rows go to disk, so that memory does not grow with them and a process that
is killed leaves them. At the end columns are made of them, one after the other. Joints that turn and joints that slide
have columns of their own (`joint_columns`).
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping, MutableSequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

ROWS_FOLDER = "rows"
"""Folder of the rows in the folder of a run; it is gone when the run has ended and its files are written."""
BLOCK_ROWS = 200
"""Rows between two writes: a process that is killed loses half a second of a cell at 400 Hz."""
NUMBER = "#"
"""Field of a row: its number, where rows of one table are in several files."""
_ROWS_READ = 1 << 14
"""Rows that are mapped at a time where columns are made."""


class LazyColumns(Mapping[str, NDArray[Any]]):
    """Columns that are made when they are asked for, each time anew.

    Args:
        makers: functions that make the columns, by name.
    """

    def __init__(self, makers: Mapping[str, Callable[[], NDArray[Any]]]) -> None:
        self._makers = makers

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._makers[name]()

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)


class RowFiles(Protocol):
    """What keeps its rows in files while a run goes on."""

    def columns(self) -> Mapping[str, NDArray[Any]]:
        """All rows as columns."""

    def remove(self) -> None:
        """Remove the files: the columns are in another one."""


class Rows:
    """Rows of one structured type, in order.

    Args:
        dtype: type of a row.
        file: file that `flush` writes to; None keeps the rows in memory.
        kept: number of rows that are kept, the last ones, in memory; None for all.

    Attributes:
        failure: why nothing more is written, None while there is no such reason; rows then stay in memory.
    """

    def __init__(self, dtype: DTypeLike, file: Path | None = None, kept: int | None = None) -> None:
        self.dtype = np.dtype(dtype)
        self.failure: str | None = None
        self._path = file
        self._written = 0
        self._waiting: MutableSequence[bytes] = [] if kept is None else deque(maxlen=kept)

    def __len__(self) -> int:
        return self._written + sum(map(len, self._waiting)) // self.dtype.itemsize

    def add(self, row: bytes) -> None:
        """Append a row, or several that follow each other."""
        self._waiting.append(row)

    def flush(self) -> None:
        """Write the rows that wait into the file, where there is one."""
        if self._path is None or self.failure is not None or not self._waiting:
            return
        data = b"".join(self._waiting)
        header = self._header(self._written + len(data) // self.dtype.itemsize)
        try:
            self._path.parent.mkdir(exist_ok=True)
            with io.FileIO(self._path, "r+" if self._written else "w") as file:
                _write_at(file, len(header) + self._written * self.dtype.itemsize, data)
                _write_at(file, 0, header)  # last: whoever is killed before has the rows before
        except OSError as error:
            self.failure = f"{self._path}: cannot be written: {error.strerror or error}"
            return
        self._written += len(data) // self.dtype.itemsize
        self._waiting.clear()

    def blocks(self) -> Iterator[NDArray[Any]]:
        """All rows, in structured arrays that follow each other."""
        start = len(self._header(self._written)) if self._written else 0
        for first in range(0, self._written, _ROWS_READ):
            assert self._path is not None
            count = min(_ROWS_READ, self._written - first)
            yield np.memmap(self._path, self.dtype, "r", start + first * self.dtype.itemsize, count)
        if self._waiting:
            data = b"".join(self._waiting)
            if isinstance(self._waiting, list):
                self._waiting = [data]  # the next column needs not join them again
            yield np.frombuffer(data, self.dtype)

    def columns(self) -> LazyColumns:
        """The fields as columns."""
        return LazyColumns({name: partial(self._column, name) for name in self.dtype.names or ()})

    def remove(self) -> None:
        """Remove the file; the rows are in another one by now."""
        if self._path is not None:
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)
                self._path.parent.rmdir()  # it goes with the last of them

    def _column(self, name: str) -> NDArray[Any]:
        return np.concatenate([np.empty(0, self.dtype)[name], *(block[name] for block in self.blocks())])

    def _header(self, rows: int) -> bytes:
        """The header of an ``.npy`` file; numpy leaves room in it for any number of rows, so its length is the same."""
        header = io.BytesIO()
        descr = [(name.encode("ascii", "backslashreplace").decode(), *kind) for name, *kind in self.dtype.descr]
        np.lib.format.write_array_header_2_0(header, {"descr": descr, "fortran_order": False, "shape": (rows,)})
        return header.getvalue()


def _write_at(file: io.FileIO, place: int, data: bytes) -> None:
    """Write all of some bytes at a place of a file."""
    file.seek(place)
    if file.write(data) < len(data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def read_left_rows(folder: Path, table: str) -> dict[str, NDArray[Any]]:
    """The columns of rows that a killed run has left, on the clock of its `bus.log`; empty where there are none.

    Args:
        folder: folder of the run.
        table: ``log``, ``tactile`` or ``truth``.

    Raises:
        OSError, ValueError: a file cannot be read.
    """
    files = sorted((folder / ROWS_FOLDER).glob(f"{table}*.npy"))
    kinds = [kind for kind in (np.load(file, mmap_mode="r") for file in files) if len(kind)]
    if not any(NUMBER in kind.dtype.names for kind in kinds):
        return {name: np.array(kind[name]) for kind in kinds for name in kind.dtype.names}
    numbers = [kind[NUMBER].astype(np.int64) for kind in kinds]
    rows, place = np.unique(np.concatenate(numbers), return_inverse=True)
    places = np.split(place, np.cumsum([len(of_kind) for of_kind in numbers])[:-1])
    columns: dict[str, NDArray[Any]] = {}
    for kind, at in zip(kinds, places, strict=True):
        for name in kind.dtype.names[1:]:
            column = columns.setdefault(name, np.full((len(rows), *kind[name].shape[1:]), np.nan))
            if column.shape[1:] == kind[name].shape[1:]:
                column[at] = kind[name]
    return columns


def joint_columns(name: str, q: NDArray[Any], prismatic: NDArray[np.bool_] | None) -> dict[str, NDArray[Any]]:
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


def joint_positions(log: Mapping[str, NDArray[Any]], name: str = "q") -> NDArray[Any] | None:
    """The inverse of `joint_columns` for a whole log: (rows, n) rad or m; None where it has no such columns.

    Args:
        log: columns by name.
        name: `q` or `q_target`.
    """
    turning, sliding = log.get(f"{name}_rad"), log.get(f"{name}_m")
    if turning is None or sliding is None:
        return sliding if turning is None else turning
    return np.where(np.isnan(turning), sliding, turning)
