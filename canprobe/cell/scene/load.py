"""Read a scene: a file and those that it names → checked `Scene`, all problems at once; and the way back.

`canprobe.cell.scene.reader` checks section by section; what goes together across keys stands in
`canprobe.cell.scene.rules`.
"""

from __future__ import annotations

import contextlib
import dataclasses
import re
import shlex
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from importlib import resources
from os.path import isdir, isfile  # False where the system refuses a name, as `Path.is_file` does not promise
from pathlib import Path
from typing import Any

from canprobe.cell.scene.checks import annotations_of, values_of
from canprobe.cell.scene.hardware import ArmSettings, CellInfo
from canprobe.cell.scene.model import DEFAULT_ARRAY, TOUCH_KINDS, ArrayFile, CellFile, Scene
from canprobe.cell.scene.plugins import find_plugin, plugins
from canprobe.cell.scene.reader import Reader
from canprobe.cell.scene.rules import SECTIONS_OF_TASK, broken_rules
from canprobe.cell.scene.toml_files import (
    parse_toml,
    read_toml,
    refuse_deep,
    toml_key,
    toml_value,
    with_writer,
    written_by_line,
)
from canprobe.errors import PlanError, SceneError, UsageError, did_you_mean

DEFAULT_CELL = "puma260"
"""Cell of a scene that names none."""
CHANGED_MARK = " (changed)"
"""Text behind the title of a scene whose object or task is no longer that of its file."""
_ALWAYS_PRESENT = ("scene", "task", "bus", "cycle", "limits", "bring_up")
FILE_KEYS = {"array", "calibration", "eds", "file", "urdf", "true_cell"}
"""Keys whose files a saved scene takes along."""
SAVED_AS = "scene.toml"
"""Name of a saved scene."""


def dump_scene(scene: Scene | CellFile) -> str:
    """The scene as a TOML document that loads back equal, with every value that its kind uses.

    Args:
        scene: a scene as `load_scene` gave it, or a cell as `read_cell` gave it.
    """
    tables: list[tuple[str, dict[str, Any]]] = []
    for name, table in _document(scene).items():
        part = getattr(scene, name)
        has_sections = isinstance(part, Mapping) and all(map(dataclasses.is_dataclass, part.values()))
        tables += [(f"{name}.{toml_key(key)}", one) for key, one in table.items()] if has_sections else [(name, table)]
    return "\n".join(
        f"[{name}]\n" + "".join(f"{toml_key(key)} = {toml_value(value)}\n" for key, value in table.items())
        for name, table in tables
    )


def _document(scene: Scene | CellFile) -> dict[str, Any]:
    """The scene as `tomllib` reads what `dump_scene` writes."""
    document: dict[str, Any] = _as_toml(_of_sections(scene, values_of))
    return {name: table for name, table in document.items() if table}


def _of_sections(whole: Scene | CellFile, take: Callable[[Any], Any]) -> dict[str, Any]:
    """What a function makes of each section that is there, by name; of named tables it takes each table."""
    parts = {field.name: getattr(whole, field.name) for field in dataclasses.fields(whole)}
    return {
        name: {key: take(section) for key, section in part.items()} if isinstance(part, Mapping) else take(part)
        for name, part in parts.items()
        if part is not None
    }


def with_files(scene: Scene) -> tuple[Scene, dict[str, bytes]]:
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
        annotations = annotations_of(type(section))
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
                cell = dataclasses.replace(read_cell(path), plant=None)
                cell = dataclasses.replace(cell, **_of_sections(cell, beside))
                files[name] = f"{written_by_line()}\n{dump_scene(cell)}".encode()
                continue
            from canprobe.mechanics.robot.urdf_visuals import with_meshes_found

            try:
                files[name] = with_meshes_found(path) if key == "urdf" else path.read_bytes()
            except OSError as error:
                raise SceneError([f"{path}: cannot be read: {error.strerror}"]) from error
        return dataclasses.replace(section, **names) if names else section

    return dataclasses.replace(scene, **_of_sections(scene, beside)), files


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
        refuse_deep(own, file)
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
    if callable(value):
        raise UsageError(f"overrides: got {value!r}; type: canprobe.sample_target, which makes a table of a function")
    return value.tolist() if hasattr(value, "tolist") else value


def load_cell(name_or_path: str | Path) -> dict[str, Any]:
    """The document of a cell file, checked section by section, with absolute paths of the files beside it.

    Args:
        name_or_path: a packaged cell's name, such as `puma260`, or the path of a TOML file.

    Raises:
        SceneError: the file has problems; the error has all of them.
    """
    return _read_hardware(name_or_path, "cell", CellFile)[1]


def read_cell(name_or_path: str | Path) -> CellFile:
    """Read a cell file as `load_cell` does, as a dataclass."""
    return CellFile(**_read_hardware(name_or_path, "cell", CellFile)[0])


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
    from canprobe.mechanics.robot.urdf import from_urdf

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


_DEVICE = ("describes a device", "canprobe conform --eds {} --node N")
_LOG = ("is a log of a bus", "canprobe replay {}, or canprobe judge SCENE --record {}")
_OTHER_FILES: Mapping[str, tuple[str, str]] = {
    ".urdf": ("describes an arm", "canprobe init my-cell --urdf {}"),
    **dict.fromkeys((".eds", ".dcf", ".xdd", ".xdc"), _DEVICE),
    **dict.fromkeys((".log", ".asc", ".blf", ".trc"), _LOG),
}
"""What a file is by its suffix that is given for a scene, and what to type with it."""


def find_file(name: str, *kinds: str) -> tuple[Path, str]:
    """The packaged file of a name, the path that the name is, or the file that another package offers.

    Args:
        name: name or path.
        kinds: kinds of file that it may be: ``scene``, ``cell``, ``array``, ``calibration``; of a folder the first one.

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
    if (other := _OTHER_FILES.get(Path(name).suffix.lower())) is not None:
        what, way = other
        raise SceneError(
            [f"{name}: {what}, and no {' or '.join(kinds)} file; type: {way.replace('{}', shlex.quote(name))}"]
        )
    if isfile(name) or name.endswith(".toml") or "/" in name:
        return Path(name), name
    for kind in kinds:
        if (plugin := find_plugin(kind, name)) is not None:
            return plugin.path(), name
    known = {kind: [*packaged_files(f"{kind}s"), *(plugin.name for plugin in plugins(kind))] for kind in kinds}
    hint = did_you_mean(name, [one for names in known.values() for one in names])
    listed = "; ".join(f"{kind}s: {', '.join(names)}" for kind, names in known.items())
    raise SceneError([f"{name}: no such {', '.join(kinds)} or file{hint}; {listed}"])


def scenes_folder() -> Path:
    """The folder of the packaged scenes, from which a copy can be made."""
    return Path(str(resources.files("canprobe"))) / "scenes"


def packaged(kind: str) -> list[tuple[str, str]]:
    """Name and title of every packaged "scene", "cell" or "array", by name."""
    files = packaged_files(f"{kind}s")
    return [(name, read_toml(path, path.name)[kind].get("title", "")) for name, path in files.items()]


def offered(kind: str, warn: Callable[[str], None]) -> list[dict[str, str]]:
    """Name, title, path and package of the scenes, cells or arrays that other packages offer.

    A name that canprobe or another package has too is given with its package.

    Args:
        kind: ``scene``, ``cell`` or ``array``.
        warn: called with a line for each that cannot be read; the others are given.
    """
    found, own = plugins(kind), packaged_files(f"{kind}s")
    taken = Counter([*own, *(plugin.name for plugin in found)])
    rows = []
    for plugin in found:
        name = plugin.name if taken[plugin.name] == 1 else plugin.whole_name
        try:
            path = plugin.path()
            title = read_toml(path, str(path)).get(kind, {}).get("title", "")
        except SceneError as error:
            warn(f"warning: {plugin.package}: {error}")
            continue
        rows.append({"name": name, "title": str(title), "path": str(path), "package": plugin.package})
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
    jointless = values.get("arm") is not None and values["arm"].kind == "external"
    for section, (need, why) in needs.items():
        if need == "must" and section not in document and not (jointless and section == "joints"):
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
