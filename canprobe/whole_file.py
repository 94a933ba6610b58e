"""Files that are whole or not there, whatever stops the writing."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A file that is written whole, under the name that is given to the block, or not at all.

    Args:
        path: what it is called afterwards; an older one is replaced.

    Raises:
        OSError: it cannot be written; no part of it is left, nor the older one.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        part.replace(path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
            if isinstance(error, OSError):
                path.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is not None:
            error.filename = str(path)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file, UTF-8, whole: see `whole_file`."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
