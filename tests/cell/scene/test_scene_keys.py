"""What `docs/generate.py` writes: the reference of all scene keys, whole, and all that was measured; up to date."""

import dataclasses
import importlib.util
import sys
import typing
from pathlib import Path

import pytest

from canprobe.cell.scene.model import Scene

DOCS = Path(__file__).parents[3] / "docs"
sys.path.append(str(DOCS))  # as for `python docs/generate.py`
_spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
generate = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(generate)

import scene_keys  # noqa: E402 - beside generate.py

SECTIONS = {name: scene_keys.section_class(hint) for name, hint in typing.get_type_hints(Scene).items()}
del SECTIONS["postures"]  # its keys are names


@pytest.mark.parametrize("section", SECTIONS)
def test_every_key_has_a_meaning(section):
    texts = scene_keys.meanings(SECTIONS[section])
    keys = [field.name for field in dataclasses.fields(SECTIONS[section])]
    assert list(texts) == keys
    assert all(text.endswith(".") for text in texts.values())


def test_all_files_are_what_the_script_writes():
    files = dict(generate.pages())
    assert {path.name for path in files} >= {"expected.json", "README.md", "scene-keys.md", "gallery.md", "accuracy.md"}
    for path, text in files.items():
        assert path.read_text(encoding="utf-8") == text, "type: python docs/generate.py"


def test_all_that_was_measured_is_on_a_page():
    """So that no figure is measured for nothing, and no page names what was not measured."""
    texts = [page.read_text("utf-8") for page in DOCS.glob("*.md")]
    marks = (generate.MARKED, generate.PRINTED_MARKED)
    named = [found[2] for text in texts for mark in marks for found in mark.finditer(text)]
    elsewhere = {"pictures", "screens", "test_lines"}
    assert sorted(named) == sorted(set(named)) == sorted({*generate.read_measured()} - elsewhere)


def test_a_key_has_its_value_unit_default_condition_and_meaning():
    row = next(line for line in scene_keys.scene_keys().splitlines() if line.startswith("| `approach_mm_s`"))
    assert row == (
        "| `approach_mm_s` | a number above 0 up to 4 | mm/s | `4.0` | Speed of the approach."
        ' *Only with `kind` = `"scan"` or `"press"` or `"calibrate"`.* |'
    )
