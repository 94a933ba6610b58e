"""Finished cells of a sweep on disk.

A line of `cells.jsonl` is the SHA-256 of its document, a space, and the document: the cell's key, what it was
measured by and at, and the answer. Lines are added whole and at once; one that was cut short or changed is left out
and counted. The key is a digest of the measuring function, the cell and the model (`model_digest`): an answer of
other code is not found.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
import platform
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any

import canprobe
from canprobe.errors import ResultsError, StudyError
from canprobe.fieldbus.bus.files import make_folder, writing
from canprobe.fieldbus.bus.real.interrupts import interrupts_held
from canprobe.fieldbus.bus.system import system

PACKAGE = Path(canprobe.__file__).parent
_SOURCES = (".py", ".toml", ".eds")


def as_json(value: object) -> str:
    """Canonical JSON: dataclasses are objects, arrays and tuples lists, keys sorted; NaN and infinity are kept."""
    return json.dumps(value, sort_keys=True, default=_as_json_type, ensure_ascii=False)


def _as_json_type(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if hasattr(value, "tolist"):  # numpy's scalars and arrays
        return value.tolist()
    raise TypeError(f"expected numbers, text, lists, mappings, arrays or dataclasses of them, got {type(value)}")


@functools.cache
def model_digest(parts: tuple[str, ...] = ()) -> str:
    """Digest of the code that answers rest on, of Python and of numpy.

    Args:
        parts: files and folders of the package, such as "mechanics/touch" or "lab/studies/bound.py"; by default the
            whole package.

    Raises:
        StudyError: a part is not there.
    """
    found: set[Path] = set()
    for part in parts or (".",):
        where = PACKAGE / part
        inside = [where] if where.is_file() else [p for p in where.rglob("*") if p.suffix in _SOURCES]
        if not inside:
            raise StudyError(f"model: expected a file or folder of the package, got {part!r}")
        found.update(inside)
    digest = hashlib.sha256(f"{platform.python_version()} {version('numpy')}".encode())
    for path in sorted(found):
        digest.update(f"\n{path.relative_to(PACKAGE)}\n".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def cell_key(measure: str, cell: object, model: str) -> str:
    """The key of an answer."""
    return hashlib.sha256(as_json([measure, cell, model]).encode()).hexdigest()[:32]


class CellStore:
    """The finished cells in a folder; open in one process at a time.

    Args:
        folder: made if it does not exist.
        fresh: forget what is kept.

    Attributes:
        path: path of the file.
        answers: the answers as JSON text, by key.
        damaged: number of lines that were left out because they were cut short or changed.

    Raises:
        ResultsError: the folder cannot be written.
        StudyError: another process has it open.
    """

    def __init__(self, folder: Path, *, fresh: bool = False) -> None:
        make_folder(folder)
        self.path = folder / "cells.jsonl"
        self.damaged = 0
        self.answers: dict[str, str] = {}
        with writing(self.path):
            self._file: IO[str] = self.path.open("a+", encoding="utf-8", errors="replace")
        try:
            system.lock(self._file)
        except OSError as error:
            self._file.close()
            raise StudyError(
                f"{self.path}: another study is writing here; wait for it, or give another --out"
            ) from error
        self._file.seek(0)
        if fresh:
            self._file.truncate()
        self._read()

    def close(self) -> None:
        """Close the file; others may open it."""
        with contextlib.suppress(OSError):  # `put` has reported it
            self._file.close()

    def put(self, key: str, what: object, answer: str) -> None:
        """Keep an answer (JSON text) with what it answers; nothing happens where its key has one.

        An interrupt waits until the line is whole: whoever then keeps what is ready does not write it twice.

        Raises:
            ResultsError: it cannot be written; what was kept before is whole.
        """
        if key in self.answers:
            return
        document = as_json({"key": key, "what": what, "answer": json.loads(answer)})
        with interrupts_held():
            try:
                self._file.write(f"{_checksum(document)} {document}\n")
                self._file.flush()
            except OSError as error:
                raise ResultsError(f"{self.path}: cannot be written: {error.strerror or error}") from error
            self.answers[key] = answer

    def _read(self) -> None:
        last = "\n"
        for last in self._file:
            checksum, _, document = last.rstrip("\n").partition(" ")
            if checksum != _checksum(document):
                self.damaged += 1
                continue
            found = json.loads(document)
            self.answers[found["key"]] = as_json(found["answer"])
        if not last.endswith("\n"):  # cut short: the next answer begins a new line
            self._file.write("\n")
            self._file.flush()


def _checksum(document: str) -> str:
    return hashlib.sha256(document.encode()).hexdigest()[:16]
