"""Read a scene: TOML text → checked `Scene`, all problems at once; and the way back.

`Reader` knows no key by name. A file is a dataclass whose fields are sections: `Section`, `Section | None`, or
`Mapping[str, Section]` for named tables (`[section.NAME]`). A section is a dataclass whose fields are keys, with type,
checks and default (`canprobe.cell.scene.model`). What goes together across keys stands in `canprobe.cell.scene.rules`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
import tomllib
import typing
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from importlib import resources
from os.path import isdir, isfile  # False where the system refuses a name, as `Path.is_file` does not promise
from pathlib import Path
from typing import Any

from canprobe import __version__
from canprobe.cell.scene.checks import MAX_NUMBER, MismatchError, Only, ScenePath, choices_of, conditions_of, convert
from canprobe.cell.scene.hardware import ArmSettings, CellInfo
from canprobe.cell.scene.model import DEFAULT_ARRAY, RENAMED_KEYS, TOUCH_KINDS, ArrayFile, CellFile, Scene
from canprobe.cell.scene.offers import find_offer, offers
from canprobe.cell.scene.rules import SECTIONS_OF_TASK, broken_rules
from canprobe.errors import PlanError, SceneError, UsageError, did_you_mean, regular_file
from canprobe.mechanics.robot.urdf import from_urdf
from canprobe.mechanics.robot.urdf_visuals import with_meshes_found

DEFAULT_CELL = "puma260"
"""Cell of a scene that names none."""
CHANGED_MARK = " (changed)"
"""Text behind the title of a scene whose object or task is no longer that of its file."""
_ALWAYS_PRESENT = ("scene", "task", "bus", "cycle", "limits", "bring_up")
FILE_KEYS = {"array", "calibration", "eds", "file", "urdf", "true_cell"}
"""Keys whose files a saved scene takes along."""
SAVED_AS = "scene.toml"
"""Name of a saved scene."""
WRITTEN_BY_KEY = "written_by"
"""Key above the sections of a file that canprobe wrote; its value names the version."""
MAX_BYTES, MAX_DEPTH = 64 << 20, 32
"""Largest size of a TOML file, and deepest nesting of its tables and lists."""
_ESCAPES = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\t": "\\t", "\r": "\\r", "\b": "\\b", "\f": "\\f"}


_ANNOTATIONS: dict[type, Mapping[str, Any]] = {}


def _annotations(cls: type[Any]) -> Mapping[str, Any]:
    """The types of a dataclass's fields, evaluated once: that takes longer than to read a file."""
    if cls not in _ANNOTATIONS:
        _ANNOTATIONS[cls] = typing.get_type_hints(cls, include_extras=True)
    return _ANNOTATIONS[cls]


def dump_scene(scene: Scene | CellFile) -> str:
    """The scene as a TOML document that loads back equal, with every value that its kind uses.

    Args:
        scene: a scene as `load_scene` gave it, or a cell as `read_cell` gave it.
    """
    tables: list[tuple[str, Mapping[str, Any]]] = []
    for name, part in ((field.name, getattr(scene, field.name)) for field in dataclasses.fields(scene)):
        if isinstance(part, Mapping) and all(map(dataclasses.is_dataclass, part.values())):
            tables += [(f"{name}.{toml_key(key)}", _values(section)) for key, section in part.items()]
        elif part is not None:
            tables.append((name, part if isinstance(part, Mapping) else _values(part)))
    return "\n".join(
        f"[{name}]\n" + "".join(f"{toml_key(key)} = {toml_value(value)}\n" for key, value in table.items())
        for name, table in tables
    )


def _document(scene: Scene) -> dict[str, Any]:
    """The scene as `tomllib` reads what `dump_scene` writes."""
    parts = ((field.name, getattr(scene, field.name)) for field in dataclasses.fields(scene))
    return {
        name: {key: _values(section) for key, section in part.items()} if isinstance(part, Mapping) else _values(part)
        for name, part in parts
        if part is not None and part != {}
    }


def _values(section: Any) -> Any:
    """The keys of a section that have a value and belong to the others; what is no section as TOML has it."""
    if not dataclasses.is_dataclass(section):
        return _as_toml(section)
    annotations, values = _annotations(type(section)), {}
    for field in dataclasses.fields(section):
        value = getattr(section, field.name)
        only = conditions_of(annotations[field.name], Only)
        if value is not None and all(getattr(section, one.key) in one.values for one in only):
            values[field.name] = _as_toml(value)
    return values


def written_by_line() -> str:
    """The first line of a file that this canprobe writes."""
    return f"{WRITTEN_BY_KEY} = {toml_value(f'canprobe {__version__}')}\n"


def with_writer(document: Mapping[str, Any], file: str) -> tuple[dict[str, Any], str]:
    """A document with present keys without `WRITTEN_BY_KEY`, and the name of its file in messages, with its writer.

    Raises:
        SceneError: the writer is no text, or a key stands under its former name and its present one.
    """
    writer = document.get(WRITTEN_BY_KEY, f"canprobe {__version__}")
    if not isinstance(writer, str):
        raise SceneError([f"{file}: {WRITTEN_BY_KEY}: expected text, got {toml_value(writer)}; remove the line"])
    rest = {name: value for name, value in document.items() if name != WRITTEN_BY_KEY}
    for (section, former), present in RENAMED_KEYS.items():
        table, where = rest.get(section), f"{file}: {section}"
        if section == "joints" and isinstance(table, dict):
            rest[section] = {name: _renamed(one, former, present, f"{where}.{name}") for name, one in table.items()}
        elif section in rest:
            rest[section] = _renamed(table, former, present, where)
    return rest, f"{file}{written_by_other(writer)}"


def _renamed(table: object, former: str, present: str, where: str) -> object:
    """A table with a key under its present name, with a warning."""
    if not isinstance(table, dict) or former not in table:
        return table
    if present in table:
        raise SceneError([f"{where}.{former}: it is now {present}, which stands there too; remove {former}"])
    warnings.warn(
        f"{where}.{former} is now {present}; the next minor version refuses {former}", FutureWarning, stacklevel=2
    )
    return {present if key == former else key: value for key, value in table.items()}


def written_by_other(writer: object) -> str:
    """`: written by canprobe …` for messages about a file of another version; empty for one of this version."""
    own = f"canprobe {__version__}"
    return "" if writer == own else f": written by {writer or 'an earlier canprobe'}, this is {own}"


def gathered(scene: Scene) -> tuple[Scene, dict[str, bytes]]:
    """A scene that names its EDS, URDF, calibration, surface and cell files as they stand beside it, and those files.

    A folder with these files, and the scene as `SAVED_AS`, loads as the scene, wherever the folder is moved. Packaged
    files are not among them. A URDF that is taken along has absolute paths of its meshes.

    Raises:
        SceneError: a file, or the true cell, cannot be read.
    """
    taken: dict[str, Path] = {SAVED_AS: Path()}
    files: dict[str, bytes] = {}

    def beside(section: Any) -> Any:
        if not dataclasses.is_dataclass(section) or isinstance(section, type):
            return section
        annotations = _annotations(type(section))
        names = {}
        for key in FILE_KEYS & set(annotations):
            value = getattr(section, key)
            if value is None or not isfile(value):
                continue
            path, number = Path(value), 1
            name = path.name
            while taken.setdefault(name, path) != path:
                number += 1
                name = f"{path.stem}-{number}{path.suffix}"
            names[key] = name
            if key == "true_cell":  # the plant of a true cell has no say
                cell = moved(dataclasses.replace(read_cell(path), plant=None))
                files[name] = f"{written_by_line()}\n{dump_scene(cell)}".encode()
                continue
            try:
                files[name] = with_meshes_found(path) if key == "urdf" else path.read_bytes()
            except OSError as error:
                raise SceneError([f"{path}: cannot be read: {error.strerror}"]) from error
        return dataclasses.replace(section, **names) if names else section

    def moved(whole: Any) -> Any:
        parts = {field.name: getattr(whole, field.name) for field in dataclasses.fields(whole)}
        changed: dict[str, Any] = {
            name: {key: beside(section) for key, section in part.items()} if isinstance(part, Mapping) else beside(part)
            for name, part in parts.items()
            if part is not None
        }
        return dataclasses.replace(whole, **changed)

    return moved(scene), files


def toml_key(key: str) -> str:
    """One key as TOML writes it."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml_value(key)


def toml_value(value: object) -> str:
    """One value as TOML writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{"".join(map(_escaped, value))}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{toml_key(key)} = {toml_value(item)}' for key, item in value.items())}}}"
    return repr(value) if isinstance(value, int | float) else str(value)


def _escaped(character: str) -> str:
    if character in _ESCAPES:
        return _ESCAPES[character]
    return f"\\u{ord(character):04X}" if ord(character) < 0x20 or ord(character) == 0x7F else character


def load_scene(scene: Scene | str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """Read a scene, or change one.

    Args:
        scene: a packaged scene's name, such as `cylinder`, the path of a TOML file, or a scene. A cell stands for a
            scene that moves its arm freely.
        overrides: values in the place of the scene's, by key as a file has them: `{"task.force_n": 3}`. They are
            checked as those of a file are. None takes a key away, so that its default holds; a table takes the place
            of a whole section; `{"cell": "puma560"}` names another cell.

    Returns:
        The scene, checked; its attributes are the sections and keys of a scene file.

    Raises:
        SceneError: the scene has problems; the error has all of them, each with file, key path, what was expected and
            what was got.
        UsageError: there is no such scene, or `overrides` is not a mapping.
    """
    whole = False
    if isinstance(scene, Scene):
        if not overrides:
            return scene
        whole = isinstance(overrides, Mapping) and all(path.partition(".")[0] != "sensor" for path in overrides)
        own, file, folder = _document(scene), scene.name, None
    elif isinstance(scene, str | Path):
        path, file = find_file(str(scene), "scene", "cell")
        folder = path.parent
        own = _as_scene(read_toml(path, file, "; `canprobe scenes` lists the packaged ones"))
    else:
        raise UsageError(f"scene: expected a packaged name, the path of a TOML file or a Scene, got {scene!r}")
    if overrides:
        own, file = _with_overrides(own, overrides, file), f"{file} as changed"
        _refuse_deep(own, file)
    return _scene(own, file, folder, whole=whole)


def _with_overrides(own: Mapping[str, Any], overrides: Mapping[str, Any], file: str) -> dict[str, Any]:
    """A document with values put in by key path."""
    if not isinstance(overrides, Mapping):
        raise UsageError(f'overrides: expected values by key such as {{"task.force_n": 3}}, got {overrides!r}')
    if "cell" in overrides and isinstance(own.get("cell"), dict):
        other = toml_value(_as_toml(overrides["cell"]))
        raise SceneError([f"{file}: cell: the scene describes its cell itself, got {other} in its place"])
    changed = dict(own)
    for path, value in overrides.items():
        *sections, key = _key_path(path)
        table = changed
        for name in sections:
            within = table.get(name)
            table[name] = dict(within) if isinstance(within, dict) else {}
            table = table[name]
        if value is None:
            table.pop(key, None)
        else:
            table[key] = _as_toml(value)
    info, touched = changed.get("scene"), {path.partition(".")[0] for path in overrides if path != "task.duration_s"}
    if isinstance(info, dict) and info.get("title") and touched & {"object", "task"} and "scene.title" not in overrides:
        changed["scene"] = {**info, "title": f"{str(info['title']).removesuffix(CHANGED_MARK)}{CHANGED_MARK}"}
    return changed


def _key_path(path: str) -> list[str]:
    """The keys of a dotted path, as TOML reads it."""
    if re.fullmatch(r"[A-Za-z0-9_-]+(\.[A-Za-z0-9_-]+)*", path):
        return path.split(".")
    try:
        table, keys = tomllib.loads(f"{path} = 0"), []
    except (ValueError, RecursionError):
        raise UsageError(f"overrides: expected a key such as task.force_n, got {path!r}") from None
    while isinstance(table, dict):
        (key, table), *_ = table.items()
        keys.append(key)
    return keys


def _as_toml(value: Any) -> Any:
    """A value of Python, numpy or pathlib as `tomllib` would have read it."""
    if isinstance(value, Mapping):
        return {key: _as_toml(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_toml(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return value.tolist() if hasattr(value, "tolist") else value


def load_cell(name_or_path: str | Path) -> dict[str, Any]:
    """The document of a cell file, checked section by section, with absolute paths of the files beside it.

    Args:
        name_or_path: a packaged cell's name, such as `puma260`, or the path of a TOML file.

    Raises:
        SceneError: the file has problems; the error has all of them.
    """
    return _read_cell(name_or_path)[1]


def read_cell(name_or_path: str | Path) -> CellFile:
    """Read a cell file as `load_cell` does, as a dataclass."""
    return _read_cell(name_or_path)[0]


def _read_cell(name_or_path: str | Path) -> tuple[CellFile, dict[str, Any]]:
    sections, document = _read_hardware(name_or_path, "cell", CellFile)
    return CellFile(**sections), document


def _read_hardware(name_or_path: str | Path, what: str, kind: type[Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """The sections of a cell or array file, and its document with the paths of the files beside it."""
    path, file = find_file(str(name_or_path), what)
    document, file = with_writer(read_toml(path, file), file)
    reader = Reader(path.parent)
    sections = reader.read(kind, document, (what,))
    _complain_of_names(reader, sections.get("arm"), document.get("joints"))
    reader.refuse(file)
    return sections, reader.with_paths(document)


def _complain_of_names(reader: Reader, arm: ArmSettings | None, joints: object) -> None:
    """Complain of joints that the URDF does not have; without other problems `arm_model` does, with the order."""
    if not reader.problems or arm is None or not arm.urdf or not isinstance(joints, dict):
        return
    with contextlib.suppress(PlanError):  # the URDF's own faults come once the cell can be read
        names = from_urdf(arm.urdf, arm.base, arm.tip).chain.joints
        for name in joints:
            if name not in names:
                hint = did_you_mean(name, names)
                reader.complain(f"joints.{toml_key(name)}", f"no joint of {arm.urdf}{hint}")


def load_array(name_or_path: str | Path) -> dict[str, Any]:
    """The document of an array file, as `load_cell` gives that of a cell.

    Args:
        name_or_path: a packaged array's name, such as `inch16`, or the path of a TOML file.

    Raises:
        SceneError: the file has problems; the error has all of them.
    """
    document = _read_hardware(name_or_path, "array", ArrayFile)[1]
    if "sensor" not in document:
        raise SceneError([f"{name_or_path}: expected an array file, got none of its keys: it needs a section [sensor]"])
    return document


def find_file(name: str, *kinds: str) -> tuple[Path, str]:
    """The packaged file of a name, the path that the name is, or the file that another package offers.

    Args:
        name: name or path.
        kinds: kinds of file that it may be: ``scene``, ``cell``, ``array``, ``calibration``; the first one is that of
            messages.

    Returns:
        Path of the file, and its name in messages.

    Raises:
        SceneError: there is no such file, with the nearest name; two packages offer one; or a package is broken.
    """
    for kind in kinds:
        if (own := packaged_files(f"{kind}s").get(name.removeprefix("canprobe:"))) is not None:
            return own, own.name
    if inside := sorted(Path(name).glob("*.toml")) if isdir(name) else []:
        raise SceneError([f"{name}: is a folder; type the {kinds[0]} file in it: {', '.join(map(str, inside))}"])
    if isfile(name) or name.endswith(".toml") or "/" in name:
        return Path(name), name
    for kind in kinds:
        if (offer := find_offer(kind, name)) is not None:
            return offer.path(), name
    packaged, others = [*packaged_files(f"{kinds[0]}s")], [offer.name for offer in offers(kinds[0])]
    hint = did_you_mean(name, packaged + others)
    of_others = f"; of other packages: {', '.join(others)}" if others else ""
    raise SceneError(
        [f"{name}: no such {kinds[0]} or file{hint}; packaged {kinds[0]}s: {', '.join(packaged)}{of_others}"]
    )


def scenes_folder() -> Path:
    """The folder of the packaged scenes, from which a copy can be made."""
    return Path(str(resources.files("canprobe"))) / "scenes"


def packaged_scenes() -> list[tuple[str, str]]:
    """Name and title of every packaged scene, by name."""
    return _titles("scenes", "scene")


def packaged_cells() -> list[tuple[str, str]]:
    """Name and title of every packaged cell, by name."""
    return _titles("cells", "cell")


def packaged_arrays() -> list[tuple[str, str]]:
    """Name and title of every packaged array, by name."""
    return _titles("arrays", "array")


def _titles(folder: str, section: str) -> list[tuple[str, str]]:
    files = packaged_files(folder)
    return [(name, read_toml(path, path.name)[section].get("title", "")) for name, path in files.items()]


def offered(kind: str, warn: Callable[[str], None]) -> list[dict[str, str]]:
    """Name, title, path and package of the scenes, cells or arrays that other packages offer.

    A name that canprobe or another package has too is given with its package.

    Args:
        kind: ``scene``, ``cell`` or ``array``.
        warn: called with a line for each that cannot be read; the others are given.
    """
    found, own = offers(kind), packaged_files(f"{kind}s")
    taken = Counter([*own, *(offer.name for offer in found)])
    rows = []
    for offer in found:
        name = offer.name if taken[offer.name] == 1 else offer.whole_name
        try:
            path = offer.path()
            title = read_toml(path, str(path)).get(kind, {}).get("title", "")
        except SceneError as error:
            warn(f"warning: {offer.package}: {error}")
            continue
        rows.append({"name": name, "title": str(title), "path": str(path), "package": offer.package})
    return rows


def packaged_files(folder: str) -> dict[str, Path]:
    """Paths of the packaged `scenes`, `cells`, `arrays` or `calibrations`, by name."""
    return {path.stem: path for path in sorted((scenes_folder().parent / folder).glob("*.toml"))}


def parse_scene(text: str, *, file: str = "scene", folder: Path | None = None) -> Scene:
    """Turn TOML text into a checked scene.

    Args:
        text: the TOML document.
        file: name of the document in messages.
        folder: folder in which files that the scene names are looked up first.

    Raises:
        SceneError: the text has problems; the error has all of them.
    """
    return _scene(parse_toml(text, file), file, folder)


def read_toml(path: Path, file: str, else_what: str = "") -> dict[str, Any]:
    """The document of a TOML file, whose messages call it `file`; `else_what` ends that of a file that is missing.

    Raises:
        SceneError: the file cannot be read, or is not TOML.
    """
    try:
        text = regular_file(path, MAX_BYTES).read_text(
            encoding="utf-8-sig"
        )  # some editors begin with a byte order mark
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
    _refuse_deep(document, file)
    return document


_NAMED_LEVELS = 3
"""Levels of the key that a message about deep nesting names; a scene has as many, such as joints.joint_1.gear."""


def _refuse_deep(document: Mapping[str, Any], file: str) -> None:
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


def _scene(own: dict[str, Any], file: str, folder: Path | None, *, whole: bool = False) -> Scene:
    """The scene in a document, with the keys of its cell and the sections that its task has by default.

    Everything is checked together. A whole document has what its array file says: the file is not read again.
    """
    own, file = with_writer(_as_scene(own), file)
    task = own.get("task")
    kind = task.get("kind") if isinstance(task, dict) else None
    needs = SECTIONS_OF_TASK.get(kind, {}) if isinstance(kind, str) else {}
    defaults = [section for section, (need, _) in needs.items() if need == "default"]
    unused = [section for section, (need, _) in needs.items() if need in ("never", "may")]
    document = _with_cell(own, file, folder, unused)
    if not whole:
        document = _with_array(document, folder)
    reader = Reader(folder)
    values = reader.read(Scene, document, (*_ALWAYS_PRESENT, *defaults))
    for section, (need, why) in needs.items():
        if need == "must" and section not in document:
            reader.complain(section, f'missing: task.kind = "{kind}" needs a section [{section}]: {why}')
        elif need == "never" and section in document:
            reader.complain(section, f'not with task.kind = "{kind}": {why}; remove the section')

    cell = own.get("cell", DEFAULT_CELL)
    if kind in TOUCH_KINDS and cell != DEFAULT_CELL and isinstance(task, dict) and "start_mm" not in task:
        other = cell if isinstance(cell, str) else "the scene's own [cell]"
        reader.complain("task.start_mm", f"missing: left out, it is a place of the cell {DEFAULT_CELL}, not of {other}")

    def lookup(path: str) -> Any:
        section, _, key = path.partition(".")
        if path in reader.bad or section in reader.bad:
            raise LookupError(path)
        found = values.get(section)
        return getattr(found, key, None) if key else found

    for where, complaint in broken_rules(lookup):
        reader.complain(where, complaint)
    _complain_of_names(reader, values.get("arm"), document.get("joints"))
    reader.refuse(file)
    return Scene(**values)


def _as_scene(own: dict[str, Any]) -> dict[str, Any]:
    """The document of a scene; that of a cell alone becomes a scene that moves the arm freely."""
    if not _are_tables(own.get("cell")) or {"scene", "task"} & set(own):
        return own
    used = {name: table for name, table in own.items() if SECTIONS_OF_TASK["free"].get(name, ("",))[0] != "never"}
    name = own["cell"].get("name", CellInfo().name)
    return {"scene": {"name": name}, "task": {"kind": "free"}, **used}


def _with_cell(own: Mapping[str, Any], file: str, folder: Path | None, unused: Iterable[str]) -> dict[str, Any]:
    """A scene's document over that of its cell, key by key; without the cell's sections that its task does not use."""
    named = own.get("cell", DEFAULT_CELL)
    if isinstance(named, dict):
        return dict(own)
    if not isinstance(named, str):
        raise SceneError([f"{file}: cell: expected the name or the path of a cell, got {toml_value(named)}"])
    cell = folder / named if folder is not None and isfile(folder / named) else named
    hardware = {name: table for name, table in load_cell(cell).items() if name not in unused}
    _refuse_part_of_new_joint(own.get("joints"), hardware.get("joints"), file)
    return _merged(hardware, {name: table for name, table in own.items() if name != "cell"})


def _refuse_part_of_new_joint(own: object, of_cell: object, file: str) -> None:
    """Refuse keys of a joint that the cell has under another name: a joint of its own would state its counts."""
    if not isinstance(own, dict) or not isinstance(of_cell, dict):
        return
    problems = [
        f"{file}: joints.{toml_key(name)}: the cell has no such joint{did_you_mean(name, of_cell)}; it has"
        f" {', '.join(of_cell)}"
        for name, table in own.items()
        if name not in of_cell and isinstance(table, dict) and not {"counts_per_turn", "counts_per_m"} & set(table)
    ]
    if problems:
        raise SceneError(problems)


def _with_array(document: dict[str, Any], folder: Path | None) -> dict[str, Any]:
    """A document over that of the array file that its sensor names, key by key."""
    sensor = document.get("sensor")
    if not isinstance(sensor, dict):
        return document
    named = sensor.get("array", DEFAULT_ARRAY)
    if not isinstance(named, str):
        return document  # said when the section is read
    path = folder / named if folder is not None and isfile(folder / named) else named
    below = {name: table for name, table in load_array(path).items() if name != "array"}
    if not isfile(path) and (found := find_file(named, "array")[0]).parent != scenes_folder().parent / "arrays":
        document = _merged(document, {"sensor": {"array": str(found)}})  # that of another package, taken along
    return _merged(below, document)


def _merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    both = {key: _merged(below[key], above[key]) for key in below if _are_tables(below[key], above.get(key))}
    return {**below, **above, **both}


def _are_tables(*values: object) -> bool:
    return all(isinstance(value, dict) for value in values)


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
        sections, needed = _annotations(file), set(needed)
        for name in document:
            if name not in sections:
                self.complain(name, f"unknown section{_did_you_mean_key(name, sections)}")
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
        annotations = _annotations(cls)
        for key in table:
            if key not in annotations:
                above = '; cell = "NAME" stands above the first section' if key == "cell" else ""
                hint = above or did_you_mean(key, _keys_that_belong(cls, annotations, table))
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


_OTHER_UNITS = (
    ("_mm", 1e3, "metres"),
    ("_mm_s", 1e3, "m/s"),
    ("_us", 1e6, "seconds"),
    ("_ms", 1e3, "seconds"),
    ("_s", 1e-3, "milliseconds"),
    ("_kpa", 1e-3, "Pa"),
    ("_n_m3", 1e9, "N/mm³"),
    ("_hz", 1e3, "kHz"),
    ("bitrate", 1e3, "kbit/s"),
)
"""End of a key, factor from another usual unit to that of the key, and that unit."""


def _other_unit(path: str, raw: object, annotation: Any) -> str:
    """A hint where a number out of range would be one in another unit; else empty."""
    if isinstance(raw, bool) or not isinstance(raw, int | float) or not abs(raw) < MAX_NUMBER:
        return ""
    for end, factor, unit in _OTHER_UNITS:
        value = float(f"{raw * factor:.12g}")
        if re.search(f"(?<!_mm)(?<!_deg)(?<!_nm){end}$", path):
            with contextlib.suppress(MismatchError):
                convert(int(value) if value.is_integer() else value, annotation)
                return f"; did you mean {value:g}, for {raw:g} {unit}?"
    return ""


def _keys_that_belong(cls: type[Any], annotations: Mapping[str, Any], table: Mapping[str, Any]) -> list[str]:
    """The keys of a section whose conditions hold in it."""
    values = {field.name: field.default for field in dataclasses.fields(cls)} | dict(table)
    return [
        key
        for key, annotation in annotations.items()
        if all(values[only.key] in only.values for only in conditions_of(annotation, Only))
    ]


def _did_you_mean_key(got: str, sections: Mapping[str, Any]) -> str:
    """A hint for an unknown section: the section that has a key of that name, or the nearest section."""
    classes = {name: next(iter(typing.get_args(hint)), hint) for name, hint in sections.items()}
    keys = [f"{name}.{got}" for name, cls in classes.items() if got in getattr(cls, "__dataclass_fields__", {})]
    return f"; did you mean {' or '.join(keys)}?" if keys else did_you_mean(got, sections)
