"""Read a scene: TOML text → checked `Scene`, all problems at once; and the way back.

`Reader` knows no key by name. A file is a dataclass whose fields are sections: `Section`, `Section | None`, or
`tuple[Section, ...]` for a list of tables (`[[section]]`). A section is a dataclass whose fields are keys, with type,
checks and default (`canprobe.scene.model`). What goes together across keys stands in `canprobe.scene.rules`.
"""

from __future__ import annotations

import dataclasses
import difflib
import tomllib
import typing
from collections.abc import Iterable, Mapping
from importlib import resources
from os.path import isfile  # False where the system refuses a name, as `Path.is_file` does not promise
from pathlib import Path
from typing import Any

from canprobe.errors import SceneError
from canprobe.scene.checks import MismatchError, Only, ScenePath, choices_of, conditions_of, convert
from canprobe.scene.model import Scene
from canprobe.scene.rules import SECTIONS_OF_TASK, broken_rules

_ALWAYS = ("scene", "task", "bus", "cycle", "limits", "bring_up")
_ESCAPES = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\t": "\\t", "\r": "\\r", "\b": "\\b", "\f": "\\f"}


def dump_scene(scene: Scene) -> str:
    """The scene as a TOML document that loads back equal, with every value that its kind uses.

    Args:
        scene: a scene as `load_scene` gave it.
    """
    tables = []
    for name, part in ((field.name, getattr(scene, field.name)) for field in dataclasses.fields(scene)):
        many = isinstance(part, tuple)
        title = f"[[{name}]]" if many else f"[{name}]"
        tables += [f"{title}\n{_keys(section)}" for section in (part if many else (part,)) if section is not None]
    return "\n".join(tables)


def _keys(section: Any) -> str:
    annotations, lines = typing.get_type_hints(type(section), include_extras=True), ""
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        only = conditions_of(annotations[field.name], Only)
        if value is not None and all(getattr(section, one.key) in one.values for one in only):
            lines += f"{field.name} = {toml_value(value)}\n"
    return lines


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


def _escaped(character: str) -> str:
    if character in _ESCAPES:
        return _ESCAPES[character]
    return f"\\u{ord(character):04X}" if ord(character) < 0x20 or ord(character) == 0x7F else character


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
    if not isfile(path) and not name.endswith(".toml") and "/" not in name:
        hint = _did_you_mean(name, packaged)
        raise SceneError([f"{name}: no such scene or file{hint}; packaged scenes: {', '.join(packaged)}"])
    file = path.name if name in packaged else name
    return _scene(read_toml(path, file), file, path.parent)


def scenes_folder() -> Path:
    """Where the packaged scenes are, for a copy to change."""
    return Path(str(resources.files("canprobe"))) / "scenes"


def packaged_scenes() -> list[tuple[str, str]]:
    """Name and title of every packaged scene, by name."""
    return [(name, load_scene(name).title) for name in _packaged_files()]


def _packaged_files() -> dict[str, Path]:
    return {path.stem: path for path in sorted(scenes_folder().glob("*.toml"))}


def parse_scene(text: str, *, file: str = "scene", folder: Path | None = None) -> Scene:
    """Turn TOML text into a checked scene.

    Args:
        text: the TOML document.
        file: what messages call it.
        folder: where files that the scene names are looked up first.

    Raises:
        SceneError: with every problem found.
    """
    return _scene(parse_toml(text, file), file, folder)


def read_toml(path: Path, file: str) -> dict[str, Any]:
    """The document of a TOML file, whose messages call it `file`.

    Raises:
        SceneError: it cannot be read, or is not TOML.
    """
    try:
        return parse_toml(path.read_text(encoding="utf-8-sig"), file)  # some editors begin with a byte order mark
    except OSError as error:
        raise SceneError([f"{file}: cannot be read: {error.strerror}"]) from error
    except UnicodeDecodeError as error:
        raise SceneError([f"{file}: not UTF-8 text: byte {error.start} is {error.object[error.start]:#04x}"]) from error


def parse_toml(text: str, file: str) -> dict[str, Any]:
    """The document in a TOML text; as `read_toml`."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # an integer of thousands of digits is no TOMLDecodeError
        raise SceneError([f"{file}: not valid TOML: {error}"]) from error


def _scene(document: Mapping[str, Any], file: str, folder: Path | None) -> Scene:
    """The scene in a document, with the sections that its task has by default, and everything checked together."""
    task = document.get("task")
    kind = task.get("kind") if isinstance(task, dict) else None
    needs = SECTIONS_OF_TASK.get(kind, {}) if isinstance(kind, str) else {}
    defaults = [section for section, (need, _) in needs.items() if need == "default"]
    reader = Reader(folder)
    values = reader.read(Scene, document, (*_ALWAYS, *defaults))
    for section, (need, why) in needs.items():
        if need == "must" and section not in document:
            reader.complain(section, f'missing: task.kind = "{kind}" needs a section [{section}]: {why}')
        elif need == "never" and section in document:
            reader.complain(section, f'not with task.kind = "{kind}": {why}; remove the section')

    def lookup(path: str) -> Any:
        section, _, key = path.partition(".")
        if path in reader.bad or section in reader.bad:
            raise LookupError(path)
        found = values.get(section)
        return getattr(found, key, None) if key else found

    for where, complaint in broken_rules(lookup):
        reader.complain(where, complaint)
    if reader.problems:
        raise SceneError([f"{file}: {problem}" for problem in reader.problems])
    return Scene(**values)


class Reader:
    """Reads tables as the dataclasses that describe them, and collects what is wrong.

    Attributes:
        problems: each with its key path.
        bad: the key paths that have one.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.problems: list[str] = []
        self.bad: set[str] = set()
        self._folder = folder

    def complain(self, path: str, message: str) -> None:
        """Note a problem."""
        self.bad.add(path)
        self.problems.append(f"{path}: {message}")

    def read(self, file: type[Any], document: Mapping[str, Any], needed: Iterable[str] = ()) -> dict[str, Any]:
        """The sections of a file, by name.

        Args:
            file: dataclass of the sections.
            document: as `tomllib` gives it.
            needed: sections that are read as empty ones where they are missing.
        """
        sections, needed = typing.get_type_hints(file), set(needed)
        for name in document:
            if name not in sections:
                self.complain(name, f"unknown section{_did_you_mean(name, sections)}")
        return {
            name: self._list(hint, document.get(name, []), name)
            if typing.get_origin(hint) is tuple
            else self.section(next(iter(typing.get_args(hint)), hint), document.get(name, {}), name)
            for name, hint in sections.items()
            if name in document or name in needed
        }

    def _list(self, hint: Any, tables: Any, name: str) -> tuple[Any, ...]:
        if not isinstance(tables, list):
            self.complain(name, f"expected a list of sections [[{name}]], got {toml_value(tables)}")
            return ()
        cls = typing.get_args(hint)[0]
        return tuple(self.section(cls, table, f"{name}[{at}]") for at, table in enumerate(tables, start=1))

    def section(self, cls: type[Any], table: Any, name: str) -> Any:
        """One section; a key that has a problem or is missing is None in it."""
        if not isinstance(table, dict):
            return self.complain(name, f"expected a section [{name}], got {toml_value(table)}")
        annotations = typing.get_type_hints(cls, include_extras=True)
        for key in table:
            if key not in annotations:
                self.complain(f"{name}.{key}", f"unknown key{_did_you_mean(key, annotations)}")
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
            hint = _did_you_mean(raw, choices_of(annotation)) if isinstance(raw, str) else ""
            return self.complain(path, f"expected {mismatch}, got {toml_value(raw)}{hint}")
        if conditions_of(annotation, ScenePath) and self._folder and isfile(self._folder / value):
            return str((self._folder / value).resolve())
        return value

    def _check_condition(self, path: str, given: bool, only: Only, actual: Any) -> None:
        """A key stands where it belongs, and nowhere else."""
        if given and actual is not None and actual not in only.values:
            needed = " or ".join(f'"{value}"' for value in only.values)
            self.complain(path, f'only with {only.key} = {needed}, got {only.key} = "{actual}"')
        elif not given and only.required and actual in only.values:
            self.complain(path, f'missing: {only.key} = "{actual}" needs it')


def _did_you_mean(got: str, known: Iterable[str]) -> str:
    folded = {word.lower(): word for word in known}
    close = difflib.get_close_matches(got.lower(), folded, n=1, cutoff=0.5)
    return f"; did you mean {folded[close[0]]}?" if close else ""
