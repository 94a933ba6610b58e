"""Columns in an ``.npz`` file, which is written whole and read with care."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import UsageError, regular_file
from canprobe.fieldbus.bus.files import whole_file


def write_npz(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays into exactly this file, compressed, whole: numpy would append ``.npz`` to a name.

    The lowest level of compression takes half the time of numpy's; the files are up to 13 % larger.
    """
    with (
        whole_file(path) as part,
        part.open("wb") as file,
        zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as saved,
    ):
        for name, column in columns.items():
            with saved.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(column), allow_pickle=False)


def read_npz(path: Path, expected: str = "an .npz of a run") -> dict[str, NDArray[Any]]:
    """Every array of an ``.npz`` file.

    Args:
        path: path of the file.
        expected: what the file should be, in words, for the message.

    Raises:
        UsageError: there is no such file, or it is cut off, empty or of another kind. Memory is allocated for the bytes
            in the file, whatever its headers say.
    """
    try:
        with regular_file(path).open("rb") as opened:
            if opened.read(len(np.lib.format.MAGIC_PREFIX)) == np.lib.format.MAGIC_PREFIX:
                raise ValueError("a single array")
            with zipfile.ZipFile(opened) as saved:
                return {entry.filename.removesuffix(".npy"): _read_array(saved, entry) for entry in saved.infolist()}
    except Exception as error:  # zip files, their compression and numpy's headers each have their own
        raise UsageError(f"{path}: expected {expected}; cannot be read: {_why(error)}") from error


def _why(error: Exception) -> str:
    """The message of an error of a file reader, in a line."""
    text = error.strerror if isinstance(error, OSError) else None
    return (text or str(error) or type(error).__name__).partition("\n")[0]


def _read_array(saved: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    """One array of plain values, whose header and size agree."""
    with saved.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, fortran, dtype = read(file)
        if dtype.hasobject:
            raise ValueError(f"{entry.filename} holds Python objects")
        if math.prod(shape) * dtype.itemsize != entry.file_size - file.tell():
            raise ValueError(f"{entry.filename} is no array of shape {shape}, as its header says")
        flat = np.frombuffer(bytearray(file.read()), dtype)
    return flat.reshape(shape, order="F" if fortran else "C")
