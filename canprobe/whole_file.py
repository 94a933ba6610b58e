"""Files that are whole or not there, whatever stops the writing."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A file that is written whole, under the name that is given to the block, or not at all.

    Args:
        path: what it is called afterwards; an older one is replaced, a link followed, a device or a pipe written to.

    Raises:
        OSError: it cannot be written; no part of it is left, nor the older one.
    """
    if path.exists() and not path.is_file():
        yield path
        return
    whole = path.resolve()
    part = whole.with_name(f".{whole.name}.part")
    try:
        yield part
        part.replace(whole)
    except BaseException as error:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
            if isinstance(error, OSError):
                whole.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is not None:
            error.filename = str(path)
        raise


def write_text(path: Path, text: str) -> None:
    """Write a text file, UTF-8, whole: see `whole_file`."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8")
