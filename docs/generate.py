"""What the pages take from the code: keys of a scene, figures and gallery of the packaged ones; with `notebooks`, what
these show.

`python docs/generate.py [notebooks]`
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import re
import sys
import tempfile
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from canprobe.results.expected import FIGURES, expected_text, range_text, read_expected, seeds_text
from canprobe.scene.checks import Only, conditions_of, expected
from canprobe.scene.load import packaged_scenes, toml_value
from canprobe.scene.model import Scene
from canprobe.scene.rules import SECTIONS_OF_TASK

DOCS = Path(__file__).parent
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


def with_expected(page: str) -> str:
    """A page with the table of expected figures between its marks."""
    expected = read_expected()
    columns = ("contact", "force", "curvature", "normal", "position", "tool")
    lines = [
        f"| scene | {' | '.join(FIGURES[name][0] for name in columns)} |",
        "| --- |" + " --- |" * len(columns),
    ]
    for scene, figures in expected["scenes"].items():
        if figures:
            found = {name.removesuffix("_per_m"): range_text(name, between) for name, between in figures.items()}
            lines.append(f"| `{scene}` | {' | '.join(found.get(name, '–') for name in columns)} |")
    return _between(page, [*lines, "", _source(expected, seeds_text(expected))])


def _source(expected: Mapping[str, Any], seeds: str, scene: str | None = None) -> str:
    """Where figures come from: those of one scene, or of all, with the ones that were measured apart."""
    apart = expected.get("apart", {})
    head = apart.get(scene, expected)
    where = f"on {head['date']} at commit {head['commit']}: {head['machine']}"
    others = "" if scene else "".join(f"; `{k}` on {v['date']} at commit {v['commit']}" for k, v in apart.items())
    what = f"Lowest to highest of the seeds {seeds} on the lockstep bus"
    return f"{what}. Measured by `python docs/measure.py` {where}{others}."


def with_accuracy(readme: str) -> str:
    """The README with the errors of the default scan in its sentence on them."""
    figures = read_expected()["one_scan"]["figures"]
    force, curvature = (
        next(f"{low:g}–{high:g} %" for what, (low, high) in figures.items() if what.startswith(start))
        for start in ("true force, RMS", "curvature after")
    )
    readme = re.sub(r"(errs\sby\s)[\d.–]+ %(\s\(RMS\))", rf"\g<1>{force}\2", readme)
    return re.sub(r"(and the curvature\sby\s)[\d.–]+ %", rf"\g<1>{curvature}", readme)


def _between(page: str, lines: list[str]) -> str:
    """A page with lines between its marks."""
    head, mark, rest = page.partition("<!-- expected -->\n")
    return "".join([head, mark, "\n".join(["", *lines, "", ""]), rest[rest.index("<!-- /expected -->") :]])


def with_one_scan(page: str) -> str:
    """The page on accuracy with the figures of the default scan between its marks."""
    expected = read_expected()
    seeds, rows = expected["one_scan"]["seeds"], expected["one_scan"]["figures"]
    lines = ["| figure | reached |", "| --- | --- |"]
    for what, (low, high) in rows.items():
        lines.append(f"| {what} | {low:g}{'' if low == high else f'–{high:g}'} |")
    return _between(page, [*lines, "", _source(expected, f"{seeds[0]} to {seeds[-1]}", "cylinder")])


def gallery() -> str:
    """The page of pictures; `python docs/gallery.py` draws them."""
    expected = read_expected()
    rows = [GALLERY, _source(expected, seeds_text(expected))]
    for name, title in packaged_scenes():
        figures = expected_text(expected["scenes"].get(name, {}))
        rows += [f"## `{name}`", f"{title}.", *([f"To expect: {figures}."] if figures else [])]
        rows += [f"![A panel of the report of {name}](img/scenes/{name}.png)"]
    return "\n\n".join(rows) + "\n"


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
    scenes = DOCS / "scenes.md"
    scenes.write_text(with_expected(scenes.read_text(encoding="utf-8")), encoding="utf-8")
    readme = DOCS.parent / "README.md"
    readme.write_text(with_accuracy(readme.read_text(encoding="utf-8")), encoding="utf-8")
    accuracy = DOCS / "accuracy.md"
    accuracy.write_text(with_one_scan(accuracy.read_text(encoding="utf-8")), encoding="utf-8")
    (DOCS / "gallery.md").write_text(gallery(), encoding="utf-8")
    (DOCS / "scene-keys.md").write_text(scene_keys(), encoding="utf-8")
    if "notebooks" in sys.argv:
        execute_notebooks()
