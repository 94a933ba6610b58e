"""Files that are whole or not there, whatever stops the writing."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from canprobe.errors import ResultsError


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """A block that writes a file, or makes or removes one.

    Raises:
        ResultsError: the system refuses that: a full disk, no permission, no such folder, another file in the way.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        raise ResultsError(f"{path}: cannot be written: {error.strerror or error}") from error


def make_folder(folder: Path) -> None:
    """Make a folder for files, and those above it, where they are missing.

    Raises:
        ResultsError: it cannot be made, or is no folder.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A file that is written whole, under the name that is given to the block, or not at all.

    That name is of the same folder and has the same suffix, by which libraries choose what to write. A block that
    writes nothing there leaves everything as it was.

    Args:
        path: what it is called afterwards; an older one is replaced, a link followed, a device or a pipe written to.

    Raises:
        ResultsError: it cannot be written, for example on a full disk or without permission; an older one is as it
            was.
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
        if isinstance(error, OSError) and error.filename in (None, str(part)):  # else of something else
            with writing(path):
                raise
        raise


def write_text(path: Path, text: str, *, encoding: str = "utf-8", newline: str | None = None) -> None:
    """Write a text file whole: see `whole_file`; encoding and line ends as for `open`."""
    with whole_file(path) as part:
        part.write_text(text, encoding=encoding, newline=newline)
