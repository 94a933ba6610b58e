"""Read a scene: TOML text → checked `Scene`, all problems at once; and the way back.

The reader knows no key by name: sections and keys, their types, ranges and defaults stand in `canprobe.scene`, what
goes together in `canprobe.scene.rules`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import tomllib
import typing
from collections.abc import Iterable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from canprobe.errors import SceneError
from canprobe.scene.checks import MismatchError, Only, ScenePath, choices_of, conditions_of, convert
from canprobe.scene.model import Scene
from canprobe.scene.rules import SECTIONS_OF_TASK, broken_rules

# Write a scene as TOML: every value that was resolved, nothing that its kind does not use.


def dump_scene(scene: Scene) -> str:
    """The scene as a TOML document that loads back equal.

    Args:
        scene: a scene as `load_scene` gave it.
    """
    sections = [(field.name, getattr(scene, field.name)) for field in dataclasses.fields(scene)]
    return "\n".join(_section(name, section) for name, section in sections if section is not None)


def toml_value(value: object) -> str:
    """One value as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{"".join(map(_escaped, value))}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {toml_value(item)}' for key, item in value.items())}}}"
    return repr(value) if isinstance(value, int | float) else str(value)


def _section(name: str, section: Any) -> str:
    annotations = typing.get_type_hints(type(section), include_extras=True)
    lines = [
        f"{field.name} = {toml_value(value)}\n"
        for field in dataclasses.fields(section)
        if (value := getattr(section, field.name)) is not None and _applies(section, annotations[field.name])
    ]
    return f"[{name}]\n{''.join(lines)}"


def _applies(section: Any, annotation: Any) -> bool:
    return all(getattr(section, only.key) in only.values for only in conditions_of(annotation, Only))


_ESCAPES = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\t": "\\t", "\r": "\\r", "\b": "\\b", "\f": "\\f"}


def _escaped(character: str) -> str:
    if character in _ESCAPES:
        return _ESCAPES[character]
    return f"\\u{ord(character):04X}" if ord(character) < 0x20 or ord(character) == 0x7F else character


# Read a scene: TOML text → checked `Scene`, all problems at once; and the way back.

_ALWAYS = ("scene", "task", "bus", "cycle", "limits", "bring_up")


def load_scene(name_or_path: str | Path) -> Scene:
    """Read a scene.

    Args:
        name_or_path: a packaged scene's name, such as `cylinder`, or the path of a TOML file.

    Raises:
        SceneError: with every problem found, each with file, key path, what was expected and what was got.
    """
    name = str(name_or_path)
    packaged = _packaged_files()
    path = packaged.get(name, Path(name))
    try:
        text = path.read_text(encoding="utf-8-sig")  # some editors begin a file with a byte order mark
    except OSError as error:
        raise SceneError([_not_readable(name, error, packaged)]) from error
    except UnicodeDecodeError as error:
        raise SceneError([f"{name}: not UTF-8 text: byte {error.start} is {error.object[error.start]:#04x}"]) from error
    return parse_scene(text, file=path.name if name in packaged else name, folder=path.parent)


def scenes_folder() -> Path:
    """Where the packaged scenes are, for a copy to change."""
    return Path(str(resources.files("canprobe"))) / "scenes"


def packaged_scenes() -> list[tuple[str, str]]:
    """Name and title of every packaged scene, by name."""
    return [(name, load_scene(name).title) for name in _packaged_files()]


def parse_scene(text: str, *, file: str = "scene", folder: Path | None = None) -> Scene:
    """Turn TOML text into a checked scene.

    Args:
        text: the TOML document.
        file: what messages call it.
        folder: where files that the scene names are looked up first.

    Raises:
        SceneError: with every problem found.
    """
    try:
        document = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # an integer of thousands of digits is no TOMLDecodeError
        raise SceneError([f"{file}: not valid TOML: {error}"]) from error
    reader = _Reader(document, folder)
    scene = reader.read()
    if scene is None:
        raise SceneError([f"{file}: {problem}" for problem in reader.problems])
    return scene


class _Reader:
    """Reads one document and collects its problems."""

    def __init__(self, document: Mapping[str, Any], folder: Path | None) -> None:
        self.problems: list[str] = []
        self._document = document
        self._folder = folder
        self._bad: set[str] = set()
        self._values: dict[str, dict[str, Any]] = {}

    def read(self) -> Scene | None:
        """The scene, or None when there are problems."""
        sections = _sections()
        for name in self._document:
            if name not in sections:
                self._complain(name, f"unknown section{_did_you_mean(name, sections)}")
        for name in self._present(sections):
            self._read_section(name, sections[name])
        self._check_needs()
        for where, complaint in broken_rules(self._lookup):
            self._complain(where, complaint)
        if self.problems:
            return None
        return Scene(**{name: sections[name](**values) for name, values in self._values.items()})

    def _present(self, sections: Iterable[str]) -> list[str]:
        kind = self._document["task"].get("kind") if isinstance(self._document.get("task"), dict) else None
        needs = SECTIONS_OF_TASK.get(kind, {}) if isinstance(kind, str) else {}
        defaults = {name for name, (need, _) in needs.items() if need == "default"}
        return [name for name in sections if name in self._document or name in _ALWAYS or name in defaults]

    def _read_section(self, section: str, cls: type[Any]) -> None:
        table = self._document.get(section, {})
        if not isinstance(table, dict):
            return self._complain(section, f"expected a section [{section}], got {toml_value(table)}")
        annotations = _annotations(cls)
        for key in table:
            if key not in annotations:
                self._complain(f"{section}.{key}", f"unknown key{_did_you_mean(key, annotations)}")
        values = self._values[section] = {}
        for field in dataclasses.fields(cls):
            if field.name in table:
                self._read_key(section, field.name, annotations[field.name], table[field.name])
            elif field.default is not dataclasses.MISSING:
                values[field.name] = field.default
            else:
                self._complain(f"{section}.{field.name}", f"missing{_choices(annotations[field.name])}")
        self._check_conditions(section, annotations, table)

    def _read_key(self, section: str, key: str, annotation: Any, raw: object) -> None:
        try:
            value = convert(raw, annotation)
        except MismatchError as mismatch:
            hint = _did_you_mean(raw, choices_of(annotation)) if isinstance(raw, str) else ""
            return self._complain(f"{section}.{key}", f"expected {mismatch}, got {toml_value(raw)}{hint}")
        if conditions_of(annotation, ScenePath) and self._folder:
            with contextlib.suppress(OSError):  # a name that no file can have: said where the file is read
                value = str((self._folder / value).resolve()) if (self._folder / value).is_file() else value
        self._values[section][key] = value

    def _check_conditions(self, section: str, annotations: Mapping[str, Any], table: Mapping[str, Any]) -> None:
        for key, annotation in annotations.items():
            for only in conditions_of(annotation, Only):
                actual = self._values[section].get(only.key)
                applies = actual is None or actual in only.values
                if key in table and not applies:
                    needed = " or ".join(f'"{value}"' for value in only.values)
                    self._complain(f"{section}.{key}", f'only with {only.key} = {needed}, got {only.key} = "{actual}"')
                elif key not in table and applies and only.required and actual is not None:
                    self._complain(f"{section}.{key}", f'missing: {only.key} = "{actual}" needs it')

    def _check_needs(self) -> None:
        kind = self._values.get("task", {}).get("kind")
        for section, (need, why) in SECTIONS_OF_TASK.get(kind or "", {}).items():
            if need == "must" and section not in self._document:
                self._complain(section, f'missing: task.kind = "{kind}" needs a section [{section}]: {why}')
            elif need == "never" and section in self._document:
                self._complain(section, f'not with task.kind = "{kind}": {why}; remove the section')

    def _lookup(self, path: str) -> Any:
        section, _, key = path.partition(".")
        if path in self._bad or section in self._bad:
            raise LookupError(path)
        values = self._values.get(section)
        return values if not key or values is None else values.get(key)

    def _complain(self, path: str, message: str) -> None:
        self._bad.add(path)
        self.problems.append(f"{path}: {message}")


def _annotations(cls: type[Any]) -> Mapping[str, Any]:
    return typing.get_type_hints(cls, include_extras=True)


def _sections() -> Mapping[str, type[Any]]:
    hints = typing.get_type_hints(Scene)
    return {name: next(part for part in typing.get_args(hint) or (hint,)) for name, hint in hints.items()}


def _packaged_files() -> dict[str, Path]:
    return {path.stem: path for path in sorted(scenes_folder().glob("*.toml"))}


def _not_readable(name: str, error: OSError, packaged: Mapping[str, Path]) -> str:
    if name.endswith(".toml") or "/" in name:
        return f"{name}: cannot be read: {error.strerror}"
    return f"{name}: no such scene or file{_did_you_mean(name, packaged)}; packaged scenes: {', '.join(packaged)}"


def _did_you_mean(got: str, known: Iterable[str]) -> str:
    folded = {word.lower(): word for word in known}
    close = difflib.get_close_matches(got.lower(), folded, n=1, cutoff=0.5)
    return f"; did you mean {folded[close[0]]}?" if close else ""


def _choices(annotation: Any) -> str:
    words = choices_of(annotation)
    return f": one of {', '.join(words)}" if words else ""
