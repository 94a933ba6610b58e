"""Columns in an ``.npz`` file, which is written whole and read with care.

A compressed file can hold a thousand times its size. What it unpacks to stands in its directory, and is refused before
anything is unpacked; a directory that says less is found out, because no more is unpacked than it says.
"""

from __future__ import annotations

import math
import struct
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import UsageError, regular_file
from canprobe.fieldbus.bus.files import whole_file

_MAPPED_BYTES = 1 << 20
"""Size from which an array is mapped from its file instead of read into memory."""
MAX_UNPACKED_BYTES = 1 << 30
"""Most bytes of one file that are read into memory. The files of a run are not compressed, and their arrays are mapped
where they are large: they take next to none of it."""
_LOCAL_HEADER, _FIELD = struct.Struct("<26xHH"), struct.Struct("<HH")
"""Header of an entry, which ends with the lengths of its name and its fields; head of a field. Source: PKWARE APPNOTE
6.3.10, 4.3.7 and 4.5.1."""
_ZIP64_FIELD_BYTES = 20
_COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Those of numpy. Of others zipfile unpacks all that it has read, whatever it was asked for."""


def write_npz(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays, one after the other, into exactly this file, whole: numpy would append ``.npz`` to a name.

    They are not compressed, which would take ten seconds a gigabyte, and lie so that they can be mapped.
    """
    with whole_file(path) as part, part.open("wb") as file, zipfile.ZipFile(file, "w") as saved:
        for name, column in columns.items():
            with saved.open(_aligned(f"{name}.npy", file.tell()), "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(column), allow_pickle=False)


def _aligned(name: str, place: int) -> zipfile.ZipInfo:
    """The entry of an array, with a field that fills its header up so that the array begins at a multiple of 64."""
    entry = zipfile.ZipInfo(name)
    header = place + _LOCAL_HEADER.size + len(name.encode()) + _ZIP64_FIELD_BYTES + _FIELD.size
    entry.extra = _FIELD.pack(0, size := -header % 64) + bytes(size)
    return entry


def read_npz(path: Path, expected: str = "an .npz of a run") -> dict[str, NDArray[Any]]:
    """Every array of an ``.npz`` file.

    Args:
        path: path of the file.
        expected: what the file should be, in words, for the message.

    Raises:
        UsageError: there is no such file, or it is cut off, empty or of another kind, or it unpacks to more than
            `MAX_UNPACKED_BYTES`. Large arrays that are not compressed are mapped.
    """
    try:
        with regular_file(path).open("rb") as opened:
            return unpack_npz(opened)
    except Exception as error:  # zip files, their compression and numpy's headers each have their own
        raise UsageError(f"{path}: expected {expected}; cannot be read: {_why(error)}") from error


def unpack_npz(opened: IO[bytes], *, mapped: bool = True) -> dict[str, NDArray[Any]]:
    """Every array of an open ``.npz`` file.

    Args:
        opened: the file.
        mapped: whether large arrays that are not compressed are mapped; it has to be a file of the system then.

    Raises:
        Exception: what numpy and zipfile raise of a damaged file; ValueError where it unpacks to too much.
    """
    if opened.read(len(np.lib.format.MAGIC_PREFIX)) == np.lib.format.MAGIC_PREFIX:
        raise ValueError("a single array")
    with zipfile.ZipFile(opened) as saved:
        entries = saved.infolist()
        if other := next((e for e in entries if e.compress_type not in _COMPRESSIONS), None):
            raise ValueError(f"{other.filename} is compressed in another way than numpy's")
        maps = [mapped and e.compress_type == zipfile.ZIP_STORED and e.file_size >= _MAPPED_BYTES for e in entries]
        unpacked = sum(e.file_size for e, is_mapped in zip(entries, maps, strict=True) if not is_mapped)
        if unpacked > MAX_UNPACKED_BYTES:
            raise ValueError(f"it unpacks to {unpacked} bytes, expected {MAX_UNPACKED_BYTES} at most")
        return {
            entry.filename.removesuffix(".npy"): _read_array(opened, saved, entry, is_mapped)
            for entry, is_mapped in zip(entries, maps, strict=True)
        }


def _why(error: Exception) -> str:
    """The message of an error of a file reader, in a line."""
    text = error.strerror if isinstance(error, OSError) else None
    return (text or str(error) or type(error).__name__).partition("\n")[0]


def _read_array(opened: IO[bytes], saved: zipfile.ZipFile, entry: zipfile.ZipInfo, is_mapped: bool) -> NDArray[Any]:
    """One array of plain values, whose header and size agree; a large one is mapped."""
    with saved.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(file)
        if dtype.hasobject:
            raise ValueError(f"{entry.filename} holds Python objects")
        if math.prod(shape) * dtype.itemsize != entry.file_size - file.tell():
            raise ValueError(f"{entry.filename} is no array of shape {shape}, as its header says")
        if not is_mapped:
            left = entry.file_size - file.tell()  # without a number, zipfile unpacks all that there is
            flat = np.frombuffer(bytearray(file.read(left)), dtype)
        else:
            header_bytes = file.tell()
            opened.seek(entry.header_offset)
            header = opened.read(_LOCAL_HEADER.size)
            place = entry.header_offset + len(header) + sum(_LOCAL_HEADER.unpack(header)) + header_bytes
            flat = np.asarray(np.memmap(opened, dtype, "c", place, math.prod(shape)))
    return flat.reshape(shape, order="F" if fortran else "C")
