"""Files that are written whole or not at all, whatever stops the writing, and small ones that are read whole."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from canprobe.errors import ResultsError, UsageError, regular_file

T = TypeVar("T")


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """A block that writes a file, or makes or removes one.

    Raises:
        ResultsError: the system refuses it: full disk, no permission, no such folder, or another file in the way.
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
        ResultsError: the folder cannot be made, or is a file.
    """
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A file that is written whole, under the name that is given to the block, or not at all.

    That name is in the same folder and has the same suffix, by which libraries choose what to write. A block that
    writes nothing there leaves everything as it was.

    Args:
        path: final name of the file; an older file is replaced, a link followed, a device or a pipe written to.

    Raises:
        ResultsError: the file cannot be written, for example on a full disk or without permission; an older one stays
            as it was.
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
        if isinstance(error, OSError) and error.filename in (None, str(part)):  # an error of this file
            with writing(path):
                raise
        raise


def write_text(path: Path, text: str, *, encoding: str = "utf-8", newline: str | None = None) -> None:
    """Write a text file whole, as `whole_file` does; encoding and line ends are those of `open`."""
    with whole_file(path) as part:
        part.write_text(text, encoding=encoding, newline=newline)


def read_document(path: Path, most_bytes: int, parse: Callable[[str], T], expected: str) -> T:
    """What a text file holds, parsed.

    Args:
        path: path of the file.
        most_bytes: largest size that is read.
        parse: function that reads the text; what it raises but for errors of canprobe says that the file is another.
        expected: what the file should be, in the message.

    Raises:
        UsageError: the file cannot be read, or is another; the message says why.
    """
    try:
        return parse(regular_file(path, most_bytes).read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UsageError(f"{path}: expected {expected}: {error}") from error
