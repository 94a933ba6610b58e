"""Print how many modules and lines folders of Python have, by what the lines are. Links to folders are not followed.

A line is blank or a comment, or else it belongs to a docstring (a string that stands by itself), an import or the code.
"""

from __future__ import annotations

import ast
import os
import sys
from collections import Counter
from pathlib import Path

KINDS = ("modules", "lines", "code", "docstrings", "blank", "imports", "comments")


def count(path: Path) -> Counter[str]:
    """Count the lines of one module."""
    text = path.read_text(encoding="utf-8")
    kinds = [
        "blank" if not line.strip() else "comments" if line.lstrip()[0] == "#" else "code" for line in text.splitlines()
    ]
    for node in ast.walk(ast.parse(text)):
        is_text = (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        )
        if is_text or isinstance(node, ast.Import | ast.ImportFrom):
            kind = "docstrings" if is_text else "imports"
            kinds[node.lineno - 1 : node.end_lineno] = [kind] * (node.end_lineno - node.lineno + 1)
    return Counter(kinds) + Counter(modules=1, lines=len(kinds))


def row(name: str, counted: Counter[str]) -> str:
    """One line of the table."""
    return f"{name:10}" + "".join(f"{counted[kind]:>12}" for kind in KINDS)


total: Counter[str] = Counter()
print(f"{'':10}" + "".join(f"{kind:>12}" for kind in KINDS))
for folder in sys.argv[1:]:
    paths = [Path(place, name) for place, _, names in os.walk(folder) for name in names if name.endswith(".py")]
    total += (found := sum(map(count, paths), Counter()))
    print(row(folder, found))
print(row("total", total))
