"""The packaged JSON Schemas: they accept what the loader accepts, and refuse what it refuses."""

import json
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import jsonschema
import pytest

from canprobe.cell.scene.load import load_array, load_cell, load_scene, packaged_files
from canprobe.cell.scene.schemas import KINDS, schema_line, schema_name, schema_text
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


@pytest.mark.parametrize(
    ("kind", "name", "old", "new"),
    [
        ("scene", "cylinder", "force_n = 2", "forc_n = 2"),
        ("scene", "cylinder", "force_n = 2", "force_n = -2"),
        ("scene", "cylinder", "force_n = 2", 'force_n = "2"'),
        ("scene", "cylinder", 'strategy = "weave"', 'strategy = "waeve"'),
        ("scene", "cylinder", "approach_normal = [0, 0, 1]", "approach_normal = [0, 1]"),
        ("scene", "cylinder", 'name = "cylinder"', 'name = "a b"'),
        ("scene", "cylinder", 'name = "cylinder"\n', ""),
        ("scene", "cylinder", "[sensor]", "[sensr]"),
        ("scene", "cylinder", "[arm]", "arm = 3"),
        ("cell", "puma260", 'convention = "standard"', 'convention = ""'),
        ("cell", "puma260", "node_id = 2\n", "node_id = 200\n"),
        ("cell", "puma260", "gear = 69.9733", "gera = 69.9733"),
        ("cell", "puma260", "[probe]", "[task]"),
        ("cell", "puma260", 'title = "', 'ttle = "'),
        ("array", "inch16", "rows = 16", "rows = -1"),
        ("array", "inch16", "rows = 16", "rows = 16.5"),
        ("array", "inch16", 'mount = "sphere"', "mount = true"),
        ("array", "inch16", "rate_hz = 200", "force_n = 200"),
    ],
)
def test_the_schema_refuses_what_the_loader_refuses(kind, name, old, new, tmp_path):
    text = packaged_files(f"{kind}s")[name].read_text("utf-8")
    assert text.count(old) >= 1
    (tmp_path / "changed.toml").write_text(text.replace(old, new), "utf-8")
    with pytest.raises(SceneError):
        LOAD[kind](tmp_path / "changed.toml")
    assert not READERS[kind].is_valid(tomllib.loads(text.replace(old, new)))
