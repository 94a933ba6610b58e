"""The packaged JSON Schemas: they accept what the loader accepts, and refuse nearly all that it refuses."""

import copy
import json
import random
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import jsonschema
import pytest

from canprobe.cell.scene.load import load_array, load_cell, load_scene, packaged_files
from canprobe.cell.scene.schemas import KINDS, schema_line, schema_name, schema_text
from canprobe.cell.scene.toml_files import toml_key, toml_value
from canprobe.cli import main
from canprobe.errors import SceneError

LOAD = {"scene": load_scene, "cell": load_cell, "array": load_array}
FILES = [(kind, path) for kind in KINDS for path in packaged_files(f"{kind}s").values()]
SCHEMAS = {kind: json.loads(schema_text(kind)) for kind in KINDS}
READERS = {kind: jsonschema.Draft7Validator(schema) for kind, schema in SCHEMAS.items()}


@pytest.mark.parametrize("kind", KINDS)
def test_a_schema_is_one_and_is_printed(kind, capsys):
    jsonschema.Draft7Validator.check_schema(SCHEMAS[kind])
    assert main(["schema", kind]) == 0
    assert json.loads(capsys.readouterr().out) == SCHEMAS[kind]


@pytest.mark.parametrize(("kind", "path"), FILES, ids=[path.stem for _, path in FILES])
def test_packaged_files_pass(kind, path):
    assert list(READERS[kind].iter_errors(tomllib.loads(path.read_text("utf-8")))) == []


def test_an_editor_takes_packaged_files_and_those_of_init(tmp_path):
    """tombi is the language server that the page recommends; it reads the schema that the first line names."""
    tombi = shutil.which("tombi", path=str(Path(sys.executable).parent)) or shutil.which("tombi")
    assert tombi is not None, "type: pip install -e '.[test]'"
    assert main(["init", str(tmp_path / "own")]) == 0
    for kind in KINDS:
        (tmp_path / schema_name(kind)).write_text(schema_text(kind), "utf-8")
    for kind, path in FILES:
        (tmp_path / f"{kind}-{path.name}").write_text(schema_line(kind) + path.read_text("utf-8"), "utf-8")
    linted = _lint(tombi, tmp_path)
    assert linted.returncode == 0, linted.stderr
    first = tmp_path / "own" / "first.toml"
    first.write_text(first.read_text("utf-8").replace('kind = "plane"', 'kind = "plain"'), "utf-8")
    linted = _lint(tombi, tmp_path)
    assert linted.returncode == 1
    assert "first.toml" in linted.stdout + linted.stderr


def _lint(tombi, folder):
    return subprocess.run([tombi, "lint", "--offline", "."], cwd=folder, capture_output=True, text=True, check=False)


def test_of_changed_files_the_schema_refuses_what_the_loader_refuses(tmp_path):
    """Keys, words, ranges, lengths, sections; what is left are rules across sections, which the page names."""
    rng, refused, caught = random.Random(20), 0, 0
    while refused < 200:
        kind, path = rng.choice(FILES)
        document = tomllib.loads(path.read_text("utf-8"))
        before = copy.deepcopy(document)
        rng.choice(CHANGES)(rng, kind, document)
        if document == before:
            continue
        file = tmp_path / path.name
        file.write_text(_text(document), "utf-8")
        passes = READERS[kind].is_valid(document)
        try:
            LOAD[kind](file)
        except SceneError:
            refused += 1
            caught += not passes
        else:
            assert passes, _text(document)
    assert caught >= 190


def _text(document):
    lines = [f"{toml_key(key)} = {toml_value(value)}" for key, value in document.items() if not isinstance(value, dict)]
    for name, table in document.items():
        if isinstance(table, dict):
            named = table and all(isinstance(value, dict) for value in table.values())
            for title, part in ((f"{name}.{toml_key(key)}", table[key]) for key in table) if named else [(name, table)]:
                lines += [f"[{title}]", *(f"{toml_key(key)} = {toml_value(value)}" for key, value in part.items())]
    return "\n".join(lines)


def _a_section(rng, kind, document):
    """A table of the document, and the keys that its section may have."""
    properties, found = SCHEMAS[kind]["properties"], []
    for name, table in document.items():
        if isinstance(table, dict) and name == "joints":
            found += [(one, properties[name]["additionalProperties"]) for one in table.values()]
        elif isinstance(table, dict):
            found.append((table, properties[name].get("anyOf", [{}, properties[name]])[1]))
    table, section = rng.choice(found)
    return table, section["properties"]


def _another_type(rng, kind, document):
    table, _ = _a_section(rng, kind, document)
    if table:
        table[rng.choice(list(table))] = rng.choice(["x y", True, [1], {"a": 1}, -5, 2.5, []])


def _another_size(rng, kind, document):
    table, keys = _a_section(rng, kind, document)
    limits = [key for key, one in keys.items() if "maximum" in one]
    if limits:
        table[rng.choice(limits)] = rng.choice([-(10**19), 10**19, -1, 0, 10**9])


def _another_word(rng, kind, document):
    table, keys = _a_section(rng, kind, document)
    words = [key for key, one in keys.items() if "enum" in one or "pattern" in one]
    if words:
        table[rng.choice(words)] = rng.choice(["nonsense", "", "a b"])


def _another_key(rng, kind, document):
    table, _ = _a_section(rng, kind, document)
    if table:
        key = rng.choice(list(table))
        table[key[:-1]] = table.pop(key)


def _a_key_of_another_kind(rng, kind, document):
    table, keys = _a_section(rng, kind, document)
    key = rng.choice([key for key, one in keys.items() if "default" in one or one.get("type") == "integer"] or [""])
    if key:
        table[key] = keys[key].get("default", 1)


def _one_key_less(rng, kind, document):
    table, _ = _a_section(rng, kind, document)
    if table:
        table.pop(rng.choice(list(table)))


def _another_length(rng, kind, document):
    table, _ = _a_section(rng, kind, document)
    lists = [key for key, value in table.items() if isinstance(value, list)]
    if lists:
        key = rng.choice(lists)
        table[key] = rng.choice([[*table[key], 1.0], table[key][:-1]])


def _another_section(rng, kind, document):
    document[rng.choice(list(SCHEMAS[kind]["properties"]))] = rng.choice([{}, 3])


def _one_section_less(rng, kind, document):
    document.pop(rng.choice(list(document)))


CHANGES = [
    _another_type,
    _another_size,
    _another_word,
    _another_key,
    _a_key_of_another_kind,
    _one_key_less,
    _another_length,
    _another_section,
    _one_section_less,
]
