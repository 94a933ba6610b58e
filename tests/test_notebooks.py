"""The notebooks in docs: their cells run as they stand, what they show shows, and they are stored with it."""

import ast
import json
import shutil
from pathlib import Path

import matplotlib
import pytest

NOTEBOOKS = sorted((Path(__file__).parent.parent / "docs" / "notebooks").glob("*.ipynb"))


def cells_of(path):
    return [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == "code"]


def run_cell(source, names):
    """Run a cell as a notebook does; the value of its last line, if that is an expression."""
    tree = ast.parse(source)
    shown = ast.Expression(tree.body.pop().value) if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), names)
    return None if shown is None else eval(compile(shown, "cell", "eval"), names)


FIRST = "first-run"
LONG = pytest.mark.slow(reason="a whole notebook; the default runs the first one")


@pytest.mark.parametrize(
    "path", [pytest.param(path, id=path.stem, marks=[LONG] * (path.stem != FIRST)) for path in NOTEBOOKS]
)
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for recorded in path.parent.glob("*.csv"):
        shutil.copy(recorded, tmp_path)
    with matplotlib.rc_context({"backend": "agg"}):
        names = {"__name__": "__main__"}
        for cell in cells_of(path):
            value = run_cell("".join(cell["source"]), names)
            forms = ("_repr_html_", "_repr_png_", "__repr__")
            assert value is None or any([getattr(value, form)() for form in forms if hasattr(value, form)])


@pytest.mark.parametrize("path", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])
def test_a_notebook_is_stored_with_what_it_shows(path):
    """`python docs/generate.py notebooks` stores it; the first thing to be seen is a result."""
    first, *_ = cells = cells_of(path)
    assert first["outputs"], "type: python docs/generate.py notebooks"
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert not [out for cell in cells for out in cell["outputs"] if out["output_type"] == "error"]
    assert path.stat().st_size < 500_000
