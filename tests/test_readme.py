"""The README's Python examples run as they stand; its picture is there; its commands exist."""

import re
from pathlib import Path

import pytest

from canprobe.cell.supervision_text import markdown_table
from canprobe.cli import COMMANDS

README = Path(__file__).resolve().parent.parent / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_example_runs(block, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "readme"}
    exec(compile(block, "README.md", "exec"), namespace)
    if "kappa" in block:
        first = float(re.search(r"[\d.]+", capsys.readouterr().out)[0])
        assert first == pytest.approx(20.0, abs=0.01)


def test_there_are_examples_and_the_picture():
    assert len(BLOCKS) == 3
    for picture in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", README.read_text(encoding="utf-8")):
        assert (README.parent / picture).is_file()


def test_commands_in_the_readme_exist():
    used = set(
        re.findall(r"^canprobe (\w+)|-- canprobe (\w+)|&& canprobe (\w+)", README.read_text(encoding="utf-8"), re.M)
    )
    assert {name for names in used for name in names if name} <= set(COMMANDS)


def test_the_table_of_conditions_is_the_one_that_supervises():
    assert markdown_table() in README.read_text(encoding="utf-8"), "print it: canprobe.cell.supervision_text"
