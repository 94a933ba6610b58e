"""Read the columns of a run's ``.npz`` file, or say what is wrong with it."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import UsageError


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Every array of an ``.npz`` file.

    Args:
        path: of the file.

    Raises:
        UsageError: no such file, or it is cut off, empty or something else.
    """
    try:
        with path.open("rb") as opened:  # numpy leaves a file open that it cannot read
            saved = np.load(opened, allow_pickle=False)
            if not isinstance(saved, np.lib.npyio.NpzFile):
                raise UsageError(f"{path}: expected an .npz of a run, got a single array")
            return {name: saved[name] for name in saved.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UsageError(f"{path}: expected an .npz of a run; cannot be read: {error}") from error
