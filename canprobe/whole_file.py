"""Files that are whole or not there, whatever stops the writing, and one way to say why one could not be written."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from canprobe.errors import ResultsError, UsageError

_WRONG_PATH = (FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError)


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A file that is written whole, under the name that is given to the block, or not at all.

    That name is of the same folder and has the same suffix, by which libraries choose what to write. A block that
    writes nothing there leaves everything as it was.

    Args:
        path: what it is called afterwards; an older one is replaced, a link followed, a device or a pipe written to.

    Raises:
        ResultsError: it cannot be written, for want of room say; an older one is as it was.
        UsageError: it cannot be there: no such folder, or nobody may write there.
    """
    whole = path.resolve()
    part = whole if path.exists() and not path.is_file() else whole.with_name(f".part-{whole.name}")
    try:
        yield part
        if part != whole and part.exists():
            part.replace(whole)
    except BaseException as error:
        if part != whole:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
        if not isinstance(error, OSError) or isinstance(error, BrokenPipeError):
            raise
        if error.filename not in (None, str(part)):  # of something else
            raise
        kind = UsageError if isinstance(error, _WRONG_PATH) else ResultsError
        raise kind(f"{path}: cannot be written: {error.strerror or error}") from error


def write_text(path: Path, text: str, *, encoding: str = "utf-8", newline: str | None = None) -> None:
    """Write a text file whole: see `whole_file`; encoding and line ends as for `open`."""
    with whole_file(path) as part:
        part.write_text(text, encoding=encoding, newline=newline)
