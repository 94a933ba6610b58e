"""What a page shows of a command, and pictures of a run: the commands are repeated, and code that draws is compared."""

from __future__ import annotations

import importlib
import json
import re
import sys
from pathlib import Path

import pytest

from canprobe.cell.emulated.array_faults import CELL_FAULTS
from canprobe.fieldbus.tools.judge import RULES

DOCS = Path(__file__).resolve().parent.parent / "docs"
sys.path.append(str(DOCS))  # as for `python docs/measure.py`
measure = importlib.import_module("measure")
generate = importlib.import_module("generate")
MEASURED = json.loads((DOCS / "measured.json").read_text(encoding="utf-8"))
PAGES = [DOCS.parent / "README.md", *DOCS.glob("*.md")]
TEXTS = {path.relative_to(DOCS.parent).as_posix(): path.read_text(encoding="utf-8") for path in PAGES}


@pytest.mark.slow(reason="a whole scan for each page")
@pytest.mark.parametrize("name", measure.PRINTED)
def test_a_command_prints_what_its_page_shows(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert measure.printed_by(name) == MEASURED[name]["printed"], f"type: python docs/measure.py {name}"


def test_each_of_them_is_on_a_page_and_a_choice_of_subjects_keeps_what_is_set_in():
    shown = {match[2] for text in TEXTS.values() for match in generate.PRINTED_MARKED.finditer(text)}
    assert shown == set(measure.PRINTED)
    lines = ["scene: done", "  force   2 N", "          set in", "  contact 1", "    below it", "  map 3"]
    page = "<!-- printed one force contact -->\nold\n<!-- /printed -->"
    assert generate.with_measured(page, {"one": {"printed": lines}}).splitlines()[3:-3] == lines[1:5]


@pytest.mark.parametrize("name", measure.DRAWN_BY)
def test_a_picture_is_drawn_by_the_present_code(name):
    assert any(f"img/{name})" in text for text in TEXTS.values())
    entry = "screens" if name in measure.OF_SCREENS else "pictures"
    assert MEASURED[entry]["drawn_by"][name] == measure.drawing_code(name), f"type: python docs/measure.py {entry}"


def test_a_picture_is_the_one_that_was_drawn_with_the_figures_beside_it():
    entries = [entry.get("pictures", {}) for entry in MEASURED.values()]
    noted = {name: digest for entry in entries for name, digest in entry.items()}
    shown = {path.relative_to(measure.IMAGES).as_posix() for path in measure.IMAGES.rglob("*.[pw]*")} | {"console.svg"}
    assert noted == {name: measure.picture_digest(name) for name in shown}, "type: python docs/measure.py STUDY"


def test_prose_beside_a_table_of_measurements_repeats_its_figure():
    table = dict((row[0], row[1]) for row in MEASURED["side_by_side"]["table"][1:])
    lockstep, direct = (float(table[name].split()[0]) for name in ("lockstep", "direct"))
    said = re.search(r"([\d.]+) times as fast \(\[cost\]", TEXTS["docs/python.md"])
    assert said is not None and float(said[1]) == pytest.approx(lockstep / direct, abs=0.05)


REPEATED = ("blind-0.5mm", "stuck-sphere-2-1.5s")
"""Runs of the table that the default tests repeat."""


@pytest.mark.parametrize(
    "name",
    [
        *REPEATED,
        *(
            pytest.param(name, marks=pytest.mark.slow(reason="the other runs of the table"))
            for name in measure.hard_cases.CASES
            if name not in REPEATED
        ),
    ],
)
def test_a_run_that_presses_hardest_is_the_one_of_the_table(name):
    assert measure.hard_cases.row(name) in MEASURED["hard_cases"]["table"], "type: python docs/measure.py hard_cases"


def test_prose_that_names_a_number_has_the_present_one():
    said = {
        ("README.md", r"any of (\d+) faults"): len(CELL_FAULTS),
        ("README.md", r"knows (\d+) faults of masters"): len(RULES),
        ("docs/hardware.md", r"1 Mbit/s ends at (\d+) Hz"): int(
            re.search(r"ends at (\d+) Hz", " ".join(MEASURED["realtime"]["findings"]))[1]
        ),
        ("README.md", r"tests take (\d+) minutes"): round(MEASURED["test_lines"]["minutes"][0]),
        ("README.md", r"-m ''`, (\d+)\)"): round(MEASURED["test_lines"]["minutes"][1]),
    }
    found = {key: re.search(key[1], TEXTS[key[0]]) for key in said}
    assert {key: match and int(match[1]) for key, match in found.items()} == said
