"""What pages do not say by themselves: keys of a scene, points of `conform` and imports, from the code; all that was
measured, from docs/measured.json; with `notebooks`, what these show. The figures of the packaged scenes go into the
package too.

`python docs/generate.py [notebooks]`
"""

from __future__ import annotations

import json
import re
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from conform_page import conform_page
from room_imports import imports_svg
from scene_keys import scene_keys
from schemas import FILES, schema_of

from canprobe.cell.results.expected import FIGURES, expected_text, range_text, seeds_text
from canprobe.cell.scene.load import packaged
from canprobe.fieldbus.tools.judge import RULES

DOCS = Path(__file__).parent
EXPECTED = DOCS.parent / "canprobe" / "scenes" / "expected.json"
SCHEMAS = DOCS.parent / "canprobe" / "schemas"
RULES_MARKED = re.compile(r"(<!-- rules -->).*?(<!-- /rules -->)", re.DOTALL)
MARKED = re.compile(r"(<!-- measured (\w+) -->).*?(<!-- /measured -->)", re.DOTALL)
PRINTED_MARKED = re.compile(r"(<!-- printed (\w+)((?: \w+)*) -->).*?(<!-- /printed -->)", re.DOTALL)
"""What a command prints: all of it, or the lines of some subjects with what is set in below them."""
GALLERY = """\
# Gallery of scenes

One picture for each packaged scene, with the figures to expect of it. In scans orange is the measured path of the
contact, blue the recovered surface, grey the true one. The pictures are panels of `report.png`, drawn by
`python docs/measure.py pictures` from one run each with `--bus direct`, seed 0. `canprobe run NAME` makes the whole
report, `canprobe view NAME` shows the scene in three dimensions.

What the figures mean, and why three scenes have large errors: [packaged scenes](packaged-scenes.md)."""


def read_measured() -> dict[str, Any]:
    """What `python docs/measure.py` wrote: by scene, study and bench, with command, date, commit and machine."""
    measured: dict[str, Any] = json.loads((DOCS / "measured.json").read_text(encoding="utf-8"))
    return measured


def with_measured(page: str, measured: Mapping[str, Any]) -> str:
    """A page with what was measured between its marks: `<!-- measured NAME -->` and `<!-- /measured -->`."""

    def block(found: re.Match[str]) -> str:
        return f"{found[1]}\n\n{_block(found[2], measured)}\n\n{found[3]}" if found[2] in measured else found[0]

    def printed(found: re.Match[str]) -> str:
        lines = _of_subjects(measured[found[2]]["printed"], found[3].split())
        return f"{found[1]}\n\n```text\n" + "\n".join(lines) + f"\n```\n\n{found[4]}"

    return PRINTED_MARKED.sub(printed, MARKED.sub(block, page))


def _of_subjects(lines: Sequence[str], subjects: Sequence[str]) -> list[str]:
    """The lines that begin with one of some subjects, and what is set in below; all where none is named."""
    if not subjects:
        return list(lines)
    chosen, keep = [], False
    for line in lines:
        if not line.startswith("   "):
            keep = line.split()[0] in subjects and line.startswith("  ")
        if keep:
            chosen.append(line)
    return chosen


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


def with_pace(page: str, measured: Mapping[str, Any]) -> str:
    """The page on Python with how much faster a scan is without a bus."""
    us = {row[0]: float(row[1].split()[0]) for row in measured["side_by_side"]["table"][1:]}
    return re.sub(r"[\d.]+( times as fast \(\[cost\])", rf"{us['lockstep'] / us['direct']:.1f}\1", page)


def gallery(measured: Mapping[str, Any]) -> str:
    """The page of pictures; `docs/gallery.py` draws them."""
    scenes = measured["scenes"]
    rows = [GALLERY, _source_of_scenes(scenes)]
    for name, title in packaged("scene"):
        figures = expected_text(scenes[name]["figures"])
        rows += [f"## `{name}`", f"{title}.", *([f"To expect: {figures}."] if figures else [])]
        rows += [f"![A panel of the report of {name}](img/scenes/{name}.png)"]
    return "\n\n".join(rows) + "\n"


def with_rules(page: str) -> str:
    """The page on the judge of masters, with all rules between its marks."""
    heads = ("rule", "fault of a master", "severity", "what a good one does", "source")
    rows = [(f"{r.number:02}", r.name, r.severity.value, r.expected, r.source) for r in RULES]
    return RULES_MARKED.sub(lambda found: f"{found[1]}\n\n{_table([heads, *rows])}\n\n{found[2]}", page)


def pages() -> Iterator[tuple[Path, str]]:
    """Every file that is generated, wholly or between marks, and its text."""
    measured = read_measured()
    yield EXPECTED, expected_figures(measured)
    yield DOCS / "gallery.md", gallery(measured)
    yield DOCS / "scene-keys.md", scene_keys()
    page = DOCS / "conform.md"
    yield page, conform_page(page.read_text(encoding="utf-8"), measured)
    for file in FILES:
        yield SCHEMAS / f"{file}.json", json.dumps(schema_of(file), ensure_ascii=False, indent=1) + "\n"
    yield DOCS / "img" / "imports.svg", imports_svg()
    readme = DOCS.parent / "README.md"
    yield readme, with_accuracy(readme.read_text(encoding="utf-8"), measured)
    python = DOCS / "python.md"
    yield python, with_pace(python.read_text(encoding="utf-8"), measured)
    judge = DOCS / "judge.md"
    yield judge, with_rules(judge.read_text(encoding="utf-8"))
    for page in sorted(DOCS.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        if MARKED.search(text) or PRINTED_MARKED.search(text):
            yield page, with_measured(text, measured)


def execute_notebooks() -> None:
    """Run the notebooks and store what they show; needs the extra `docs`."""
    import nbformat
    from nbclient import NotebookClient

    for path in sorted((DOCS / "notebooks").glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        with tempfile.TemporaryDirectory() as folder:
            for recorded in path.parent.glob("*.csv"):
                shutil.copy(recorded, folder)
            NotebookClient(notebook, resources={"metadata": {"path": folder}}, record_timing=False).execute()
        notebook.metadata.language_info = {"name": "python"}
        nbformat.write(notebook, path)


if __name__ == "__main__":
    for path, text in pages():
        path.write_text(text, encoding="utf-8")
    if "notebooks" in sys.argv:
        execute_notebooks()
