"""TOML as files of a cell have it: text and values both ways, and which canprobe wrote a file.

A document is refused where it is nested deeper than any scene, before anybody walks it.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from canprobe import __version__
from canprobe.errors import SceneError, regular_file

WRITTEN_BY_KEY = "written_by"
"""Key above the sections of a file that canprobe wrote; its value names the version."""
MAX_BYTES, MAX_DEPTH = 64 << 20, 32
"""Largest size of a TOML file, and deepest nesting of its tables and lists."""


def written_by_line() -> str:
    """The first line of a file that this canprobe writes."""
    return f"{WRITTEN_BY_KEY} = {toml_value(f'canprobe {__version__}')}\n"


def with_writer(document: Mapping[str, Any], file: str) -> tuple[dict[str, Any], str]:
    """A document without `WRITTEN_BY_KEY`, and the name of its file in messages, with its writer.

    Raises:
        SceneError: the writer is no text.
    """
    writer = document.get(WRITTEN_BY_KEY, f"canprobe {__version__}")
    if not isinstance(writer, str):
        raise SceneError([f"{file}: {WRITTEN_BY_KEY}: expected text, got {toml_value(writer)}; remove the line"])
    rest = {name: value for name, value in document.items() if name != WRITTEN_BY_KEY}
    return rest, f"{file}{written_by_other(writer)}"


def written_by_other(writer: object) -> str:
    """`: written by canprobe …` for messages about a file of another version; empty for one of this version."""
    own = f"canprobe {__version__}"
    return "" if writer == own else f": written by {writer or 'an earlier canprobe'}, this is {own}"


def toml_key(key: str) -> str:
    """One key as TOML writes it."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml_value(key)


def toml_value(value: object) -> str:
    """One value as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{toml_key(key)} = {toml_value(item)}' for key, item in value.items())}}}"
    return repr(value) if isinstance(value, int | float) else str(value)


def read_toml(path: Path, file: str, else_what: str = "") -> dict[str, Any]:
    """The document of a TOML file, whose messages call it `file`; `else_what` ends that of a file that is missing.

    Raises:
        SceneError: the file cannot be read, or is not TOML.
    """
    try:
        text = regular_file(path, MAX_BYTES).read_text("utf-8-sig")  # some editors begin with a byte order mark
    except OSError as error:
        hint = else_what if isinstance(error, FileNotFoundError) else ""
        raise SceneError([f"{file}: cannot be read: {error.strerror}{hint}"]) from error
    except UnicodeDecodeError as error:
        raise SceneError([f"{file}: not UTF-8 text: byte {error.start} is {error.object[error.start]:#04x}"]) from error
    return parse_toml(text, file)


def parse_toml(text: str, file: str) -> dict[str, Any]:
    """The document in a TOML text, with the errors of `read_toml`."""
    try:
        document = tomllib.loads(text)
    except ValueError as error:  # an integer of thousands of digits is no TOMLDecodeError
        raise SceneError([f"{file}: not valid TOML: {error}"]) from error
    except RecursionError:
        raise _too_deep(file) from None
    refuse_deep(document, file)
    return document


_NAMED_LEVELS = 3
"""Levels of the key that a message about deep nesting names; a scene has as many, such as joints.joint_1.gear."""


def refuse_deep(document: Mapping[str, Any], file: str) -> None:
    """Raise SceneError for tables and lists nested deeper than in any scene; other code visits them by recursion."""
    values: list[tuple[str, Any]] = [("", document)]
    for level in range(MAX_DEPTH):
        inner = [
            (f"{path}{key}." if isinstance(value, Mapping) and level < _NAMED_LEVELS else path, item)
            for path, value in values
            for key, item in (value.items() if isinstance(value, Mapping) else enumerate(value))
        ]
        values = [(path, item) for path, item in inner if isinstance(item, Mapping | list | tuple)]
        if not values:
            return
    raise _too_deep(f"{file}: {values[0][0].removesuffix('.')}")


def _too_deep(where: str) -> SceneError:
    return SceneError([f"{where}: expected tables and lists of at most {MAX_DEPTH} levels, got more of them"])
