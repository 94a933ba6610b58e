"""Rows of a run while it goes on: in memory, or in compressed blocks in a file that can be read at any moment.

A run of an hour has 1.4 million cycles. Its rows go to disk, so that memory does not grow with them and a process that
is killed leaves them. At the end columns are made of them, some at a time. Joints that turn and joints that slide
have columns of their own (`joint_columns`).

A file of rows is a gzip file, and unpacked a sequence of arrays as `numpy.save` writes them, one a block. Each row is
compressed as it comes, a few microseconds, so that no cycle carries the compression of a block.
"""

from __future__ import annotations

import contextlib
import errno
import gzip
import io
import os
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, MutableSequence, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

ROWS_FOLDER = "rows"
"""Folder of the rows in the folder of a run; it is gone when the run has ended and its files are written."""
ROWS_SUFFIX = ".npy.gz"
BLOCK_ROWS = 200
"""Rows between two writes: a process that is killed loses half a second of a cell at 400 Hz."""
TACTILE_PHASE, TRUTH_PHASE = 70, 140
"""Cycles from a write of the log's rows to that of the tactile frames and that of the truth: a cycle carries one."""
NUMBER = "#"
"""Field of a row: its number, where rows of one table are in several files."""
_COLUMNS_MADE = 8
"""Columns that are made in one pass over the rows; those of an hour take 450 MB at most."""
_GZIP_BITS = 31
"""Window of 32 kB in a gzip member. Source: zlib's manual, deflateInit2."""
_MAGIC_BYTES = np.lib.format.MAGIC_LEN
"""Start of an array; the size of its header in 4 bytes is next. Source: numpy, NEP 1, version 2.0."""
FASTEST = 1
"""Level of compression; others save little of a run's floats and take several times as long."""


class LazyColumns(Mapping[str, NDArray[Any]]):
    """Columns that are made when they are asked for, some at a time; those of the last time are kept.

    Args:
        names: names of the columns.
        make: function that makes the columns of these names.
    """

    def __init__(self, names: Sequence[str], make: Callable[[Sequence[str]], Mapping[str, NDArray[Any]]]) -> None:
        self._make = make
        self._made: Mapping[str, NDArray[Any]] = {}
        firsts = range(0, len(names), _COLUMNS_MADE)
        self._group = {name: group for i in firsts for group in (names[i : i + _COLUMNS_MADE],) for name in group}

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._made:
            group = self._group[name]
            self._made = {}  # before others take their memory
            self._made = self._make(group)
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._group)

    def __len__(self) -> int:
        return len(self._group)


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
        file: file that `flush` appends to; None keeps the rows in memory.
        kept: number of rows that are kept, the last ones, in memory; None for all.
        level: level of compression; 0 for rows that come many at a time, which would hold a cycle up.

    Attributes:
        failure: why nothing more is written, None while there is no such reason; rows then stay in memory.
    """

    def __init__(
        self, dtype: DTypeLike, file: Path | None = None, kept: int | None = None, level: int = FASTEST
    ) -> None:
        self.dtype = np.dtype(dtype)
        self.failure: str | None = None
        self._path = file
        self._written = 0
        self._waiting: MutableSequence[bytes] = [] if kept is None else deque(maxlen=kept)
        self._headers: dict[int, bytes] = {}
        self._level = level
        self._packer, self._packed = self._new_packer(), list[bytes]()

    def __len__(self) -> int:
        return self._written + sum(map(len, self._waiting)) // self.dtype.itemsize

    def add(self, row: bytes) -> None:
        """Append a row, or several that follow each other."""
        self._waiting.append(row)
        if self._path is not None and self.failure is None:
            self._packed.append(self._packer.compress(row))

    def flush(self) -> None:
        """Write the rows that wait into the file, where there is one."""
        if self._path is None or self.failure is not None or not self._waiting:
            return
        count = len(self) - self._written
        block = b"".join((self._header(count), *self._packed, self._packer.flush()))
        try:
            self._path.parent.mkdir(exist_ok=True)
            with io.FileIO(self._path, "a" if self._written else "w") as file:
                if file.write(block) < len(block):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError as error:
            self.failure = f"{self._path}: cannot be written: {error.strerror or error}"
            return
        self._written += count
        self._waiting.clear()
        self._packer, self._packed = self._new_packer(), []

    def blocks(self) -> Iterator[NDArray[Any]]:
        """All rows, in structured arrays that follow each other."""
        if self._written:
            assert self._path is not None
            yield from (block.view(self.dtype) for block in read_blocks(self._path))  # names as they are
        if self._waiting:
            data = b"".join(self._waiting)
            if isinstance(self._waiting, list):
                self._waiting = [data]  # the next column needs not join them again
            yield np.frombuffer(data, self.dtype)

    def columns(self) -> LazyColumns:
        """The fields as columns."""
        return LazyColumns(self.dtype.names or (), self._make)

    def remove(self) -> None:
        """Remove the file; the rows are in another one by now."""
        if self._path is not None:
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)
                self._path.parent.rmdir()  # it goes with the last of them

    def _make(self, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        heads = np.empty(0, self.dtype)
        made = {name: np.empty((len(self), *heads[name].shape[1:]), heads[name].dtype) for name in names}
        first = 0
        for block in self.blocks():
            for name, column in made.items():
                column[first : first + len(block)] = block[name]
            first += len(block)
        return made

    def _header(self, rows: int) -> bytes:
        """The header of an ``.npy`` file of so many rows, compressed; that of most blocks is the same."""
        if rows not in self._headers:
            header = io.BytesIO()
            descr = [(name.encode("ascii", "backslashreplace").decode(), *kind) for name, *kind in self.dtype.descr]
            np.lib.format.write_array_header_2_0(header, {"descr": descr, "fortran_order": False, "shape": (rows,)})
            self._headers[rows] = gzip.compress(header.getvalue(), FASTEST)
        return self._headers[rows]

    def _new_packer(self) -> Any:
        return None if self._path is None else zlib.compressobj(self._level, zlib.DEFLATED, _GZIP_BITS)


def read_blocks(path: Path) -> Iterator[NDArray[Any]]:
    """The rows of a file, in structured arrays that follow each other, while it is written or after a kill.

    A last block that is not whole is left out: it is being written, or was when the process was killed.

    Raises:
        ValueError: a block is damaged; the message says which rows come before it.
        OSError: the file cannot be read.
    """
    read = 0
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:  # until 0.2 rows were not compressed
        try:
            while file.peek(1):
                size = file.read(_MAGIC_BYTES + 4)[_MAGIC_BYTES:]
                count, dtype = _read_header(size + file.read(int.from_bytes(size, "little")))
                data = file.read(count * dtype.itemsize)
                if len(data) < count * dtype.itemsize:
                    return
                yield np.frombuffer(data, dtype)
                read += count
        except EOFError:
            return
        except (gzip.BadGzipFile, ValueError, zlib.error) as error:
            raise ValueError(f"{path}: damaged near row {read}: {error}") from error


@lru_cache
def _read_header(header: bytes) -> tuple[int, np.dtype[Any]]:
    """Number and type of the rows behind a header; that of most blocks of a file is the same."""
    (count,), _, dtype = np.lib.format.read_array_header_2_0(io.BytesIO(header))
    return count, dtype


def read_left_rows(folder: Path, table: str) -> dict[str, NDArray[Any]]:
    """The columns of rows that a killed run has left, on the clock of its `bus.log`; empty where there are none.

    Args:
        folder: folder of the run.
        table: ``log``, ``tactile`` or ``truth``.

    Raises:
        OSError, ValueError: a file cannot be read.
    """
    files = sorted((folder / ROWS_FOLDER).glob(f"{table}*.npy*"))
    rows = np.unique(np.concatenate([np.empty(0), *(numbers for file in files for numbers, _ in _numbered(file))]))
    columns: dict[str, NDArray[Any]] = {}
    for numbers, block in (part for file in files for part in _numbered(file)):
        known = np.isin(numbers, rows)  # of a run that goes on, others may have come
        at = np.searchsorted(rows, numbers[known])
        for name in block.dtype.names or ():
            values = block[name][known]
            missing = np.nan if values.dtype.kind == "f" else 0
            column = columns.setdefault(name, np.full((len(rows), *values.shape[1:]), missing, values.dtype))
            if column.shape[1:] == values.shape[1:]:
                column[at] = values
    columns.pop(NUMBER, None)
    return columns


def _numbered(path: Path) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """The blocks of a file, each with the numbers of its rows in their table."""
    first = 0
    for block in read_blocks(path):
        named = NUMBER in (block.dtype.names or ())
        yield block[NUMBER].copy() if named else np.arange(first, first + len(block)), block
        first += len(block)


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
