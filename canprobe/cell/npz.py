"""Columns in a compressed ``.npz`` file, which is written whole and read with care, a column at a time.

A compressed file can hold a thousand times its size. What it unpacks to stands in its directory, and is refused before
anything is unpacked; a directory that says less is found out, because no more is unpacked than it says.
"""

from __future__ import annotations

import math
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.rows import FASTEST
from canprobe.errors import UsageError, regular_file
from canprobe.fieldbus.bus.files import whole_file

MAX_UNPACKED_BYTES = 1 << 30
"""Most bytes that one column unpacks to: those of a matrix (4, 4) in the log of six hours."""
_LOCAL_HEADER = struct.Struct("<26xHH")
"""Header of an entry, which ends with the lengths of its name and its fields. Source: PKWARE APPNOTE 6.3.10, 4.3.7."""
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Those of numpy. Of others zipfile unpacks all that it has read, whatever it was asked for."""


def write_npz(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays, one after the other, into exactly this file, whole: numpy would append ``.npz`` to a name."""
    with (
        whole_file(path) as part,
        part.open("wb") as file,
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=FASTEST) as saved,
    ):
        for name, column in columns.items():
            with saved.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(column), allow_pickle=False)


@dataclass(frozen=True, slots=True)
class NpzEntry:
    """An array in a file: what its headers say, and its bytes there."""

    shape: tuple[int, ...]
    order: Literal["C", "F"]
    dtype: np.dtype[Any]
    header_bytes: int
    content: NDArray[np.uint8]
    info: zipfile.ZipInfo

    def read(self) -> NDArray[Any]:
        """The array; of a file that is not compressed it is mapped."""
        data: Any = self.content
        if self.info.compress_type == zipfile.ZIP_DEFLATED:
            if (size := self.info.file_size) > MAX_UNPACKED_BYTES:
                raise ValueError(f"it unpacks to {size} bytes, expected {MAX_UNPACKED_BYTES} at most")
            data = bytearray(zlib.decompressobj(-zlib.MAX_WBITS).decompress(self.content.data, size))
            if len(data) < size or zlib.crc32(data) != self.info.CRC:
                raise ValueError("its checksum is another: it is damaged")
        return np.frombuffer(data, self.dtype, offset=self.header_bytes).reshape(self.shape, order=self.order)


class NpzColumns(Mapping[str, NDArray[Any]]):
    """The columns of an ``.npz`` file; each is read when it is first asked for, and then kept.

    Args:
        entries: the arrays of the file, by name.
        where: the file and what is expected of it, for the message.

    Raises:
        UsageError: when a column is asked for that is damaged, or unpacks to more than `MAX_UNPACKED_BYTES`.
    """

    def __init__(self, entries: dict[str, NpzEntry], where: str) -> None:
        self._entries, self._where = entries, where
        self._kept: dict[str, NDArray[Any]] = {}

    def __getitem__(self, name: str) -> NDArray[Any]:
        if name not in self._kept:
            entry = self._entries[name]
            try:
                self._kept[name] = entry.read()
            except (ValueError, zlib.error) as error:
                raise UsageError(f"{self._where}; {name} cannot be read: {error}") from error
        return self._kept[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def pop(self, name: str) -> NDArray[Any]:
        """A column, which is no longer kept, nor one of the columns."""
        column = self[name]
        del self._kept[name], self._entries[name]
        return column

    def heads(self) -> dict[str, NDArray[Any]]:
        """Arrays of the columns' shapes and types without their values, which are not read."""
        return {name: np.broadcast_to(np.empty((), one.dtype), one.shape) for name, one in self._entries.items()}


def read_npz(path: Path, expected: str = "an .npz of a run") -> NpzColumns:
    """The arrays of an ``.npz`` file, each read when it is asked for; it may be replaced or removed meanwhile.

    Args:
        path: path of the file.
        expected: what the file should be, in words, for the message.

    Raises:
        UsageError: there is no such file, or it is cut off, empty or of another kind.
    """
    where = f"{path}: expected {expected}"
    try:
        with regular_file(path).open("rb") as opened:
            return NpzColumns(npz_entries(opened, np.asarray(np.memmap(opened, np.uint8, "c"))), where)
    except Exception as error:  # zip files, their compression and numpy's headers each have their own
        raise UsageError(f"{where}; cannot be read: {_why(error)}") from error


def npz_entries(opened: IO[bytes], content: NDArray[np.uint8]) -> dict[str, NpzEntry]:
    """The arrays of an open ``.npz`` file, by name.

    Args:
        opened: the file, which is not needed any more then.
        content: its bytes (n,).

    Raises:
        Exception: what numpy and zipfile raise of a damaged file.
    """
    if content[: len(np.lib.format.MAGIC_PREFIX)].tobytes() == np.lib.format.MAGIC_PREFIX:
        raise ValueError("a single array")
    with zipfile.ZipFile(opened) as saved:
        entries = saved.infolist()
        if other := next((e for e in entries if e.compress_type not in _COMPRESSIONS), None):
            raise ValueError(f"{other.filename} is compressed in another way than numpy's")
        return {e.filename.removesuffix(".npy"): _entry(saved, e, content) for e in entries}


def _why(error: Exception) -> str:
    """The message of an error of a file reader, in a line."""
    text = error.strerror if isinstance(error, OSError) else None
    return (text or str(error) or type(error).__name__).partition("\n")[0]


def _entry(saved: zipfile.ZipFile, info: zipfile.ZipInfo, content: NDArray[np.uint8]) -> NpzEntry:
    """One array of plain values, whose header and size agree."""
    with saved.open(info) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(file)
        header_bytes = file.tell()
    if dtype.hasobject:
        raise ValueError(f"{info.filename} holds Python objects")
    if math.prod(shape) * dtype.itemsize != info.file_size - header_bytes:
        raise ValueError(f"{info.filename} is no array of shape {shape}, as its header says")
    start = info.header_offset + _LOCAL_HEADER.size
    start += sum(_LOCAL_HEADER.unpack(content[info.header_offset : start].tobytes()))
    packed = content[start : start + info.compress_size]
    return NpzEntry(shape, "F" if fortran else "C", dtype, header_bytes, packed, info)
