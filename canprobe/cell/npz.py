"""Columns in a compressed ``.npz`` file, which is written whole and read with care, a column at a time.

A compressed file can hold a thousand times its size. What it unpacks to stands in its directory, and is refused before
anything is unpacked; a directory that says less is found out, because no more is unpacked than it says.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import UsageError, regular_file
from canprobe.fieldbus.bus.files import whole_file

MAX_UNPACKED_BYTES = 1 << 30
"""Most bytes of one column: those of a matrix (4, 4) in the log of six hours."""
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Those of numpy. Of others zipfile unpacks all that it has read, whatever it was asked for."""


def write_npz(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays, one after the other, into exactly this file, whole: numpy would append ``.npz`` to a name.

    Levels of compression above the first save little of floats, and take several times as long.
    """
    with (
        whole_file(path) as part,
        part.open("wb") as file,
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as saved,
    ):
        for name, column in columns.items():
            with saved.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(column), allow_pickle=False)


class NpzColumns(Mapping[str, NDArray[Any]]):
    """The columns of an ``.npz`` file; each is read when it is first asked for, and then kept.

    The file may be replaced or removed meanwhile. Pickled, the columns are a dict.

    Args:
        file: the file, open or its path.
        where: start of the message of a column that cannot be read.

    Attributes:
        heads: arrays of the columns' shapes and types without their values, which are not read.

    Raises:
        UsageError: when a column is asked for that is damaged, or takes more than `MAX_UNPACKED_BYTES`.
        Exception: what numpy and zipfile raise of a damaged file.
    """

    def __init__(self, file: Path | IO[bytes], where: str) -> None:
        self._where, self._saved = where, zipfile.ZipFile(file)
        self._entries: dict[str, zipfile.ZipInfo] = {}
        self._kept: dict[str, NDArray[Any]] = {}
        self.heads: dict[str, NDArray[Any]] = {}
        for entry in self._saved.infolist():
            name = entry.filename.removesuffix(".npy")
            self._entries[name], self.heads[name] = entry, _head(self._saved, entry)

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._kept:
            entry = self._entries[name]
            try:
                self._kept[name] = self._read(entry)
            except (OSError, ValueError, EOFError, zlib.error, zipfile.BadZipFile) as error:
                raise UsageError(f"{self._where}{entry.filename} cannot be read: {_why(error)}") from error
        return self._kept[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __reduce__(self) -> tuple[type[dict[str, Any]], tuple[dict[str, Any]]]:
        return dict, (dict(self),)

    def pop(self, name: str) -> NDArray[Any]:
        """A column, which is no longer kept, nor one of the columns."""
        column = self[name]
        del self._kept[name], self._entries[name], self.heads[name]
        return column

    def _read(self, entry: zipfile.ZipInfo) -> NDArray[Any]:
        if entry.file_size > MAX_UNPACKED_BYTES:
            raise ValueError(f"it unpacks to {entry.file_size} bytes, expected {MAX_UNPACKED_BYTES} at most")
        with self._saved.open(entry) as file:
            array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
        return array


def _head(saved: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    """The shape and type of an array of plain values, whose header and size agree."""
    if entry.compress_type not in _COMPRESSIONS:
        raise ValueError(f"{entry.filename} is compressed in another way than numpy's")
    with saved.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        if dtype.hasobject:
            raise ValueError(f"{entry.filename} holds Python objects")
        if math.prod(shape) * dtype.itemsize != entry.file_size - file.tell():
            raise ValueError(f"{entry.filename} is no array of shape {shape}, as its header says")
    return np.broadcast_to(np.empty((), dtype), shape)


def read_npz(path: Path, expected: str = "an .npz of a run") -> NpzColumns:
    """The arrays of an ``.npz`` file, each read when it is asked for.

    Args:
        path: path of the file.
        expected: what the file should be, in words, for the message.

    Raises:
        UsageError: there is no such file, or it is cut off, empty or of another kind.
    """
    where = f"{path}: expected {expected}; "
    try:
        with regular_file(path).open("rb") as file:
            if file.read(len(np.lib.format.MAGIC_PREFIX)) == np.lib.format.MAGIC_PREFIX:
                raise ValueError("a single array")
        return NpzColumns(path, where)
    except Exception as error:  # zip files, their compression and numpy's headers each have their own
        raise UsageError(f"{where}cannot be read: {_why(error)}") from error


def _why(error: Exception) -> str:
    """The message of an error of a file reader, in a line."""
    text = error.strerror if isinstance(error, OSError) else None
    return (text or str(error) or type(error).__name__).partition("\n")[0]
