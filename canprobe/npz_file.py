"""Columns in an ``.npz`` file: written, read, or told what is wrong with it."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import UsageError
from canprobe.whole_file import whole_file


def write_npz(path: Path, columns: Mapping[str, NDArray[Any]]) -> None:
    """Write arrays into exactly this file, compressed, whole: numpy would append ``.npz`` to a name."""
    with whole_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **columns)


def read_npz(path: Path, expected: str = "an .npz of a run") -> dict[str, NDArray[Any]]:
    """Every array of an ``.npz`` file.

    Args:
        path: of the file.
        expected: what it should be, in words.

    Raises:
        UsageError: no such file, or it is cut off, empty or something else.
    """
    try:
        with path.open("rb") as opened:  # numpy leaves a file open that it cannot read
            saved = np.load(opened, allow_pickle=False)
            if not isinstance(saved, np.lib.npyio.NpzFile):
                raise UsageError(f"{path}: expected {expected}, got a single array")
            return {name: saved[name] for name in saved.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UsageError(f"{path}: expected {expected}; cannot be read: {error}") from error
