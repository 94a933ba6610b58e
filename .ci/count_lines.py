"""Print in one line how large the house is, so that growth is seen: modules, lines by kind, and the largest classes.

A line is blank or a comment, or else it belongs to a docstring (a string that stands by itself), an import or the code.
Links to folders are not followed.
"""

from __future__ import annotations

import ast
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

HOUSES = {"package": ("canprobe", "bridge", "eds"), "tests": ("tests",)}
LARGEST = 5


def trees(folders: tuple[str, ...]) -> Iterator[tuple[list[str], ast.Module]]:
    """The lines and the syntax tree of each module."""
    for folder in folders:
        for place, _, names in os.walk(folder):
            for name in names:
                if name.endswith(".py"):
                    text = Path(place, name).read_text(encoding="utf-8")
                    yield text.splitlines(), ast.parse(text)


def count(lines: list[str], tree: ast.Module) -> Counter[str]:
    """Count the lines of one module."""
    kinds = ["blank" if not line.strip() else "comments" if line.lstrip()[0] == "#" else "code" for line in lines]
    for node in ast.walk(tree):
        is_text = (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        )
        if is_text or isinstance(node, ast.Import | ast.ImportFrom):
            kind = "docstrings" if is_text else "imports"
            kinds[node.lineno - 1 : node.end_lineno] = [kind] * (node.end_lineno - node.lineno + 1)
    return Counter(kinds) + Counter(modules=1, lines=len(kinds))


def methods(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """The number of methods of each class."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            yield sum(isinstance(part, ast.FunctionDef) for part in node.body), node.name


words = []
for house, folders in HOUSES.items():
    total = sum((count(*module) for module in trees(folders)), Counter[str]())
    kinds = ("modules", "lines", "code", "imports", "docstrings", "comments")
    words.append(f"{house} {', '.join(f'{total[kind]} {kind}' for kind in kinds)}")
largest = sorted((found for _, tree in trees(HOUSES["package"]) for found in methods(tree)), reverse=True)[:LARGEST]
words.append(f"largest classes by methods {', '.join(f'{name} {number}' for number, name in largest)}")
print("; ".join(words))
