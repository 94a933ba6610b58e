"""Reads tables as the dataclasses that describe them: every problem at once, each with what was probably meant.

`Reader` knows no key by name. A file is a dataclass whose fields are sections: `Section`, `Section | None`, or
`Mapping[str, Section]` for named tables (`[section.NAME]`). A section is a dataclass whose fields are keys, with type,
checks and default (`canprobe.cell.scene.model`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import typing
from collections.abc import Iterable, Mapping
from os.path import isfile  # False where the system refuses a name, as `Path.is_file` does not promise
from pathlib import Path
from typing import Any

from canprobe.cell.scene.checks import (
    MAX_NUMBER,
    MismatchError,
    Only,
    ScenePath,
    annotations_of,
    choices_of,
    conditions_of,
    convert,
    keys_that_belong,
)
from canprobe.cell.scene.toml_files import toml_key, toml_value
from canprobe.cell.scene.units import unit_of
from canprobe.errors import SceneError, did_you_mean


class Reader:
    """Reads tables as the dataclasses that describe them, and collects what is wrong.

    Attributes:
        problems: each with its key path.
        bad: the key paths that have one.
        paths: files that were found beside the file, by key path.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.problems: list[str] = []
        self.bad: set[str] = set()
        self.paths: dict[str, str] = {}
        self._folder = folder
        self._sections: Mapping[str, Any] = {}

    def complain(self, path: str, message: str) -> None:
        """Add a problem."""
        self.bad.add(path)
        self.problems.append(f"{path}: {message}")

    def refuse(self, file: str) -> None:
        """Raise an error with all problems, if there are any.

        Raises:
            SceneError: there are problems; the error has all of them.
        """
        if self.problems:
            raise SceneError([f"{file}: {problem}" for problem in self.problems])

    def read(self, file: type[Any], document: Mapping[str, Any], needed: Iterable[str] = ()) -> dict[str, Any]:
        """The sections of a file, by name.

        Args:
            file: dataclass of the sections.
            document: the document as `tomllib` gives it.
            needed: sections that are read as empty ones where they are missing.
        """
        sections, needed = annotations_of(file), set(needed)
        self._sections = sections
        for name in document:
            if name not in sections:
                self.complain(name, f"unknown section{_other_section(name, sections) or did_you_mean(name, sections)}")
        return {
            name: self._named(hint, document.get(name, {}), name)
            if typing.get_origin(hint) is Mapping
            else self.section(next(iter(typing.get_args(hint)), hint), document.get(name, {}), name)
            for name, hint in sections.items()
            if name in document or name in needed
        }

    def with_paths(self, table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
        """A table that was read, with the paths that were found in the place of names."""
        return {
            key: self.with_paths(value, f"{prefix}{toml_key(key)}.")
            if isinstance(value, dict)
            else self.paths.get(prefix + key, value)
            for key, value in table.items()
        }

    def _named(self, hint: Any, tables: Any, name: str) -> dict[str, Any]:
        cls = typing.get_args(hint)[1]
        has_sections = dataclasses.is_dataclass(cls)
        if not isinstance(tables, dict):
            wanted = f"sections [{name}.NAME]" if has_sections else f"a section [{name}]"
            self.complain(name, f"expected {wanted}, got {toml_value(tables)}")
            return {}
        paths = {key: f"{name}.{toml_key(key)}" for key in tables}
        read = {
            key: self.section(cls, table, paths[key]) if has_sections else self._value(table, cls, paths[key])
            for key, table in tables.items()
        }
        if None in read.values():
            self.bad.add(name)
        return read

    def section(self, cls: type[Any], table: Any, name: str) -> Any:
        """Read a section; a key that has a problem or is missing is None in it."""
        if not isinstance(table, dict):
            return self.complain(name, f"expected a section [{name}], got {toml_value(table)}")
        annotations = annotations_of(cls)
        for key in table:
            if key not in annotations:
                above = '; cell = "NAME" stands above the first section' if key == "cell" else ""
                given = {field.name: field.default for field in dataclasses.fields(cls)} | table
                hint = above or did_you_mean(key, keys_that_belong(cls, given)) or _other_section(key, self._sections)
                self.complain(f"{name}.{key}", f"unknown key{hint}")
        values: dict[str, Any] = {}
        for field in dataclasses.fields(cls):
            path, annotation = f"{name}.{field.name}", annotations[field.name]
            if field.name in table:
                values[field.name] = self._value(table[field.name], annotation, path)
            elif field.default is not dataclasses.MISSING:
                values[field.name] = field.default
            else:
                words = choices_of(annotation)
                self.complain(path, f"missing: one of {', '.join(words)}" if words else "missing")
                values[field.name] = None
        for key, annotation in annotations.items():
            for only in conditions_of(annotation, Only):
                self._check_condition(f"{name}.{key}", key in table, only, values[only.key])
        return cls(**values)

    def _value(self, raw: object, annotation: Any, path: str) -> Any:
        try:
            value = convert(raw, annotation)
        except MismatchError as mismatch:
            words = choices_of(annotation)
            hint = did_you_mean(raw, words) if isinstance(raw, str) else _other_unit(path, raw, annotation)
            return self.complain(path, f"expected {mismatch}, got {toml_value(raw)}{hint}")
        if conditions_of(annotation, ScenePath) and self._folder and isfile(self._folder / value):
            value = self.paths[path] = str((self._folder / value).resolve())
        return value

    def _check_condition(self, path: str, given: bool, only: Only, actual: Any) -> None:
        """Complain of a key that stands where it does not belong, or is missing where it must be given."""
        if given and actual is not None and actual not in only.values:
            needed = " or ".join(f'"{value}"' for value in only.values)
            self.complain(path, f'only with {only.key} = {needed}, got {only.key} = "{actual}"')
        elif not given and only.required and actual in only.values:
            self.complain(path, f'missing: {only.key} = "{actual}" needs it')


def _other_unit(path: str, raw: object, annotation: Any) -> str:
    """A hint where a number out of range would be one in another unit; else empty."""
    other = unit_of(path.rpartition(".")[2]).other
    if other is None or isinstance(raw, bool) or not isinstance(raw, int | float) or not abs(raw) < MAX_NUMBER:
        return ""
    value = float(f"{raw * other[1]:.12g}")
    with contextlib.suppress(MismatchError):
        convert(int(value) if value.is_integer() else value, annotation)
        return f"; did you mean {value:g}, for {raw:g} {other[0]}?"
    return ""


def _other_section(got: str, sections: Mapping[str, Any]) -> str:
    """A hint for an unknown section or key: the sections that have a key of that name; empty without one."""
    classes = {name: next(iter(typing.get_args(hint)), hint) for name, hint in sections.items()}
    keys = [f"{name}.{got}" for name, cls in classes.items() if got in getattr(cls, "__dataclass_fields__", {})]
    return f"; did you mean {' or '.join(keys)}?" if keys else ""
