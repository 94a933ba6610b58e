"""The reference of all scene keys: generated from the dataclasses, whole, and up to date."""

import dataclasses
import importlib.util
import typing
from pathlib import Path

import pytest

from canprobe.scene.model import Scene

DOCS = Path(__file__).parents[2] / "docs"
_spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
generate = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(generate)

SECTIONS = {name: generate.section_class(hint) for name, hint in typing.get_type_hints(Scene).items()}


@pytest.mark.parametrize("section", SECTIONS)
def test_every_key_has_a_meaning(section):
    texts = generate.meanings(SECTIONS[section])
    keys = [field.name for field in dataclasses.fields(SECTIONS[section])]
    assert list(texts) == keys
    assert all(text.endswith(".") for text in texts.values())


def test_the_page_is_what_the_script_prints():
    page = (DOCS / "scene-keys.md").read_text(encoding="utf-8")
    assert page == generate.scene_keys(), "type: python docs/generate.py"
    scenes = (DOCS / "scenes.md").read_text(encoding="utf-8")
    assert scenes == generate.with_expected(scenes), "type: python docs/generate.py"


def test_a_key_has_its_value_unit_default_condition_and_meaning():
    row = next(line for line in generate.scene_keys().splitlines() if line.startswith("| `speed_mm_s`"))
    assert row == (
        "| `speed_mm_s` | a number above 0 up to 200 | mm/s | `25.0` | Speed of the contact over the surface."
        ' *Only with `kind` = `"scan"`.* |'
    )
