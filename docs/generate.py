"""What pages do not say by themselves: keys of a scene and imports, from the code; all that was measured, from
docs/measured.json; with `notebooks`, what these show. The figures of the packaged scenes go into the package too.

`python docs/generate.py [notebooks]`
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import json
import re
import sys
import tempfile
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from room_imports import imports_svg

from canprobe.cell.results.expected import FIGURES, expected_text, range_text, seeds_text
from canprobe.cell.scene.checks import Only, conditions_of, expected
from canprobe.cell.scene.load import packaged_scenes, toml_value
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.rules import SECTIONS_OF_TASK

DOCS = Path(__file__).parent
EXPECTED = DOCS.parent / "canprobe" / "scenes" / "expected.json"
MARKED = re.compile(r"(<!-- measured (\w+) -->).*?(<!-- /measured -->)", re.DOTALL)
UNITS = {  # the longest suffix that fits
    "bitrate": "bit/s",
    "n_m3": "N/m³",
    "kg_m2": "kg m²",
    "nm_s": "N m s",
    "n_s_m": "N s/m",
    "deg_s2": "°/s²",
    "mm_s2": "mm/s²",
    "deg_s": "°/s",
    "nm": "N m",
    "counts": "units of the drive",
    "mm_s": "mm/s",
    "s_m": "s/m",
    "percent": "%",
    "permille": "‰",
    "hz": "Hz",
    "kpa": "kPa",
    "deg": "°",
    "kg": "kg",
    "mm": "mm",
    "ms": "ms",
    "us": "µs",
    "n": "N",
    "s": "s",
}
GALLERY = """\
# Gallery of scenes

One picture for each packaged scene, with the figures to expect of it. In scans orange is the measured path of the
contact, blue the recovered surface, grey the true one. The pictures are panels of `report.png`, drawn by
`python docs/gallery.py` from one run each with `--bus direct`, seed 0. `canprobe run NAME` makes the whole report,
`canprobe view NAME` shows the scene in three dimensions.

What the figures mean, and why three scenes have large errors: [scenes and plans](scenes.md#packaged-scenes)."""
NEEDS = {"must": "required", "default": "default", "may": "optional", "never": "–"}
INTRODUCTION = """\
# Scene keys

A scene is a TOML file. `canprobe scenes` lists the packaged ones and prints the folder of their files: copy one and
change it. `canprobe plan FILE` checks a scene and reports every mistake at once, with the key and, where a name is
misspelt, the name that was probably meant.

`cell = "NAME"` above the first section names the cell, arm and array, that the scene runs on: a packaged one
(`canprobe cells`) or the path of a file; `puma260` without this line. `[arm]` and `[sensor]` say that the scene uses
the arm and the array of the cell, and may be empty. `written_by` above the first section of a file that canprobe wrote
says by which version; a file of your own needs none.

A key that a scene leaves out has the value of its cell ([Your own arm](own-arm.md)), then that of the array file that
the cell names ([Your own array](own-array.md)), or else its default. The suffix of a key is its unit. Numbers may be
written with or without a decimal point. `"auto"` leaves the choice to the plan, which prints what it chose and why.

This page is generated from the definition of a scene: `python docs/generate.py`.

## Sections and tasks

`[scene]` and `[task]` are needed in every scene; `[bus]`, `[cycle]`, `[limits]`, `[bring_up]` and `[bridge]` may stand
in every scene. `[cell]`, `[arm]`, `[joints.NAME]`, `[sensor]`, `[probe]` and `[emulate]` usually come from the cell
file, and `[wire]` from the array file. The other sections depend on `task.kind`. *required*: the scene must have the
section. *default*: a scene without the section has all its defaults. *optional*: a scene without the section does
without it. *–*: the section is an error.
"""


def scene_keys() -> str:
    """The page of all scene keys."""
    sections = [(name, section_class(hint)) for name, hint in typing.get_type_hints(Scene).items()]
    return "\n".join([INTRODUCTION, *_needs(), "", *(line for name, cls in sections for line in _section(name, cls))])


def meanings(cls: type[Any]) -> dict[str, str]:
    """The text below each field of a section, by key."""
    body = typing.cast(ast.ClassDef, ast.parse(inspect.getsource(cls)).body[0]).body
    return {
        field.target.id: inspect.cleandoc(text.value.value).replace("\n", " ")
        for field, text in itertools.pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant) and isinstance(text.value.value, str)
    }


def section_class(hint: Any) -> type[Any]:
    """The dataclass of a section, from its annotation in a scene."""
    parts = typing.get_args(hint)
    cls: type[Any] = parts[1] if typing.get_origin(hint) is Mapping else next(iter(parts), hint)
    return cls


def _needs() -> Iterator[str]:
    tasks = list(SECTIONS_OF_TASK)
    yield f"| section | {' | '.join(f'`{task}`' for task in tasks)} |"
    yield "| --- |" + " --- |" * len(tasks)
    for section in SECTIONS_OF_TASK[tasks[0]]:
        needs = (NEEDS[SECTIONS_OF_TASK[task][section][0]] for task in tasks)
        title = "joints.NAME" if section == "joints" else section
        yield f"| [`[{title}]`](#{title.lower().replace('.', '')}) | {' | '.join(needs)} |"


def _section(name: str, cls: type[Any]) -> Iterator[str]:
    head, _, rest = (inspect.getdoc(cls) or "").partition("\n\n")
    about = head.partition(": ")[2].replace("\n", " ")
    yield f"## `[{'joints.NAME' if name == 'joints' else name}]`\n"
    yield about[0].upper() + about[1:]
    if rest:
        yield f"\n{rest}"
    yield "\n| key | value | unit | default | meaning |"
    yield "| --- | --- | --- | --- | --- |"
    annotations, texts = typing.get_type_hints(cls, include_extras=True), meanings(cls)
    for field in dataclasses.fields(cls):
        annotation = annotations[field.name]
        cells = (
            f"`{field.name}`",
            expected(annotation),
            _unit(field.name),
            _default(field),
            " ".join([texts[field.name], *map(_condition, conditions_of(annotation, Only))]),
        )
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
    yield ""


def _unit(key: str) -> str:
    return next((unit for suffix, unit in UNITS.items() if f"_{key}".endswith(f"_{suffix}")), "")


def _default(field: dataclasses.Field[Any]) -> str:
    if field.default is dataclasses.MISSING:
        return "required"
    return "–" if field.default is None else f"`{toml_value(field.default)}`"


def _condition(only: Only) -> str:
    values = " or ".join(f"`{toml_value(value)}`" for value in only.values)
    return f"*{'Required' if only.required else 'Only'} with `{only.key}` = {values}.*"


def read_measured() -> dict[str, Any]:
    """What `python docs/measure.py` wrote: by scene, study and bench, with command, date, commit and machine."""
    measured: dict[str, Any] = json.loads((DOCS / "measured.json").read_text(encoding="utf-8"))
    return measured


def with_measured(page: str, measured: Mapping[str, Any]) -> str:
    """A page with what was measured between its marks: `<!-- measured NAME -->` and `<!-- /measured -->`."""

    def block(found: re.Match[str]) -> str:
        return f"{found[1]}\n\n{_block(found[2], measured)}\n\n{found[3]}" if found[2] in measured else found[0]

    return MARKED.sub(block, page)


def _block(name: str, measured: Mapping[str, Any]) -> str:
    entry = measured[name]
    if name == "scenes":
        return f"{_table(_scene_rows(entry))}\n\n{_source_of_scenes(entry)}"
    parts = [_table(entry["table"])] if "table" in entry else []
    if "findings" in entry:
        parts.append("\n".join(_item(line) for line in entry["findings"]))
    return "\n\n".join([*parts, f"Measured by `{entry['command']}` {_where(entry)}."])


def _table(rows: Iterable[Sequence[str]]) -> str:
    head, *rest = rows
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rest))


def _item(line: str) -> str:
    """A finding as an item of a list; one that is set in belongs to the item before."""
    return f"{'    ' if line[0] == ' ' else ''}- {line.strip()}"


def _where(entry: Mapping[str, Any]) -> str:
    return f"on {entry['date']} at commit {entry['commit']}: {entry['machine']}"


def _scene_rows(scenes: Mapping[str, Any]) -> Iterator[list[str]]:
    columns = ("contact", "force", "curvature", "normal", "position", "tool")
    yield ["scene", *(FIGURES[name][0] for name in columns)]
    for scene, entry in scenes.items():
        found = {name.removesuffix("_per_m"): range_text(name, ends) for name, ends in entry["figures"].items()}
        if found:
            yield [f"`{scene}`", *(found.get(name, "–") for name in columns)]


def _source_of_scenes(scenes: Mapping[str, Any]) -> str:
    """Where the figures of the scenes come from: those of most, then those that were measured at another time."""
    by_origin: dict[str, list[str]] = {}
    for name, entry in scenes.items():
        by_origin.setdefault(_where(entry), []).append(name)
    (most, _), *others = sorted(by_origin.items(), key=lambda item: -len(item[1]))
    apart = "".join(f"; {', '.join(f'`{name}`' for name in names)} {where}" for where, names in others)
    seeds = seeds_text(next(iter(scenes.values())))
    what = f"Lowest to highest of the seeds {seeds} on the lockstep bus"
    return f"{what}. Measured by `python docs/measure.py` {most}{apart}."


def expected_figures(measured: Mapping[str, Any]) -> str:
    """The figures of the scenes, for the package: `canprobe scenes` and `run` show them."""
    scenes: Mapping[str, Any] = measured["scenes"]
    lines = ",\n".join(f"    {json.dumps(name)}: {json.dumps(entry['figures'])}" for name, entry in scenes.items())
    seeds = next(iter(scenes.values()))["seeds"]
    return f'{{\n  "seeds": {json.dumps(seeds)},\n  "scenes": {{\n{lines}\n  }}\n}}\n'


def with_accuracy(readme: str, measured: Mapping[str, Any]) -> str:
    """The README with the errors of the default scan in its sentence on them."""
    rows = dict(measured["one_scan"]["table"])
    force, curvature = (
        next(f"{reached} %" for what, reached in rows.items() if what.startswith(start))
        for start in ("true force off its target", "curvature after")
    )
    readme = re.sub(r"(off\sits\starget\sby\s)[\d.–]+ %(\s\(RMS\))", rf"\g<1>{force}\2", readme)
    return re.sub(r"(and the curvature\sby\s)[\d.–]+ %", rf"\g<1>{curvature}", readme)


def gallery(measured: Mapping[str, Any]) -> str:
    """The page of pictures; `python docs/gallery.py` draws them."""
    scenes = measured["scenes"]
    rows = [GALLERY, _source_of_scenes(scenes)]
    for name, title in packaged_scenes():
        figures = expected_text(scenes[name]["figures"])
        rows += [f"## `{name}`", f"{title}.", *([f"To expect: {figures}."] if figures else [])]
        rows += [f"![A panel of the report of {name}](img/scenes/{name}.png)"]
    return "\n\n".join(rows) + "\n"


def pages() -> Iterator[tuple[Path, str]]:
    """Every file that is generated, wholly or between marks, and its text."""
    measured = read_measured()
    yield EXPECTED, expected_figures(measured)
    yield DOCS / "gallery.md", gallery(measured)
    yield DOCS / "scene-keys.md", scene_keys()
    yield DOCS / "img" / "imports.svg", imports_svg()
    readme = DOCS.parent / "README.md"
    yield readme, with_accuracy(readme.read_text(encoding="utf-8"), measured)
    for page in sorted(DOCS.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        if MARKED.search(text):
            yield page, with_measured(text, measured)


def execute_notebooks() -> None:
    """Run the notebooks and store what they show; needs the extra `docs`."""
    import nbformat
    from nbclient import NotebookClient

    for path in sorted((DOCS / "notebooks").glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        with tempfile.TemporaryDirectory() as folder:
            NotebookClient(notebook, resources={"metadata": {"path": folder}}, record_timing=False).execute()
        notebook.metadata.language_info = {"name": "python"}
        nbformat.write(notebook, path)


if __name__ == "__main__":
    for path, text in pages():
        path.write_text(text, encoding="utf-8")
    if "notebooks" in sys.argv:
        execute_notebooks()
