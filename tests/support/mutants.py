"""Mutation testing of the modules that keep an arm safe: small changes, one at a time, that the nearest tests notice.

    python tests/support/mutants.py --seed 1 --count 300 --processes 2

A mutant is one changed place of one module, in a copy of the tree: a comparison, a condition, a boolean, a constant, a
sum, a returned value, a call whose result is not used. It is killed where a test fails, or takes twice the time of the
unchanged tree and a minute. Survivors are printed with their line; the share that was killed comes with its interval of
95 % (Wilson). Not part of CI: it takes hours.
"""

from __future__ import annotations

import argparse
import ast
import copy
import math
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

ROOT = Path(__file__).resolve().parents[2]
MASTER = "canprobe/cell/master"
SUPERVISION = ("tests/cell/master/test_supervision.py", "tests/cell/integration/test_supervision.py")
STOPS = (*SUPERVISION, "tests/cell/integration/test_lift_off.py", "tests/cell/integration/test_troubled_wire.py")
NEAREST = {
    "lift_off": STOPS,
    "supervisor": STOPS,
    "conditions": (*STOPS, "tests/cell/integration/test_overruns.py"),
    "drives": ("tests/cell/master/test_drives.py", "tests/cell/master/test_cycle.py", *STOPS),
    "bringup": ("tests/cell/master/test_bringup.py", "tests/cell/integration/test_mixed_nodes.py"),
    "homing": ("tests/cell/master/test_homing.py",),
    "watch": ("tests/cell/master/test_watch.py", *STOPS),
    "cycle": ("tests/cell/master/test_cycle.py", "tests/cell/integration/test_overruns.py", *SUPERVISION),
}
"""Tests to run for a module of `canprobe/cell/master`, the quickest first."""
COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
SUMS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.BitAnd: ast.BitOr}


@dataclass(frozen=True)
class Mutant:
    """One change: the module, the line, what it does, and the module's text with it."""

    module: str
    line: int
    what: str
    text: str

    def __str__(self) -> str:
        return f"{MASTER}/{self.module}.py:{self.line}: {self.what}"


def mutants_of(module: str) -> Iterator[Mutant]:
    """Every mutant of a module."""
    tree = ast.parse((ROOT / MASTER / f"{module}.py").read_text(encoding="utf-8"))
    nodes = list(ast.walk(tree))
    annotations = {id(part) for node in nodes for part in _annotations(node)}
    for at, node in enumerate(nodes):
        if id(node) in annotations:
            continue
        for variant in range(len(list(_changes(node)))):
            changed = copy.deepcopy(tree)
            target = list(ast.walk(changed))[at]
            what, change = list(_changes(target))[variant]
            change()
            yield Mutant(module, getattr(node, "lineno", 0), what, ast.unparse(ast.fix_missing_locations(changed)))


def _annotations(node: ast.AST) -> Iterator[ast.AST]:
    hints = [getattr(node, name, None) for name in ("annotation", "returns")]
    yield from (part for hint in hints if isinstance(hint, ast.AST) for part in ast.walk(hint))


def _changes(node: ast.AST) -> Iterator[tuple[str, object]]:
    """The changes of one node, each with its words and the function that makes it."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARISONS:
        new = COMPARISONS[type(node.ops[0])]()
        yield f"{type(node.ops[0]).__name__} becomes {type(new).__name__}", lambda: node.ops.__setitem__(0, new)
    if isinstance(node, ast.BoolOp):
        new_op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        yield f"{type(node.op).__name__} becomes {type(new_op).__name__}", lambda: setattr(node, "op", new_op)
        for i, value in enumerate(node.values):
            yield f"without `{ast.unparse(value)}`", lambda i=i: node.values.__delitem__(i)
    if isinstance(node, ast.BinOp) and type(node.op) in SUMS:
        sum_op = SUMS[type(node.op)]()
        yield f"{type(node.op).__name__} becomes {type(sum_op).__name__}", lambda: setattr(node, "op", sum_op)
    if isinstance(node, ast.If | ast.While | ast.IfExp):
        yield "condition denied", lambda: setattr(node, "test", ast.UnaryOp(ast.Not(), node.test))
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield f"{node.value} becomes {not node.value}", lambda: setattr(node, "value", not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield f"{node.value} becomes {node.value + 1}", lambda: setattr(node, "value", node.value + 1)
    if isinstance(node, ast.Return) and node.value is not None and not _is_none(node.value):
        yield f"return None, not `{ast.unparse(node.value)[:60]}`", lambda: setattr(node, "value", ast.Constant(None))
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        yield f"without `{ast.unparse(node)[:60]}`", lambda: setattr(node, "value", ast.Constant(None))


def _is_none(node: ast.AST) -> bool:
    return isinstance(node, ast.Constant) and node.value is None


def run_tests(tree: Path, module: str, limit_s: float | None = None) -> bool:
    """Whether the nearest tests of a module pass in a tree; not in time is not passed."""
    command = [sys.executable, "-m", "pytest", "-n0", "-x", "-q", "-p", "no:cacheprovider", *NEAREST[module]]
    environment = {**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1", "CI": "1"}
    try:
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=limit_s, check=False)
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def wilson(killed: int, count: int) -> tuple[float, float]:
    """The 95 % interval of a share, after Wilson (1927)."""
    z, share = 1.96, killed / count
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * math.sqrt(share * (1 - share) / count + z**2 / (4 * count**2))
    return middle - half, middle + half


def main() -> None:
    """Draw, try and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--modules", nargs="+", choices=NEAREST, default=list(NEAREST))
    options = parser.parse_args()
    pool = [mutant for module in options.modules for mutant in mutants_of(module)]
    drawn = random.Random(options.seed).sample(pool, min(options.count, len(pool)))
    print(f"seed {options.seed}: {len(drawn)} of {len(pool)} mutants of {', '.join(options.modules)}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        trees: SimpleQueue[Path] = SimpleQueue()
        for i in range(options.processes):
            tree = Path(folder) / str(i)
            shutil.copytree(
                ROOT, tree, symlinks=True, ignore=shutil.ignore_patterns(".git", ".venv", "runs", "site", ".*_cache")
            )
            trees.put(tree)
        limits = {}
        for module in sorted({mutant.module for mutant in drawn}):
            start = time.monotonic()
            tree = trees.get()
            if not run_tests(tree, module):
                sys.exit(f"the nearest tests of {module} fail without a mutant")
            trees.put(tree)
            limits[module] = 2 * (time.monotonic() - start) + 60
            print(f"{module}: {time.monotonic() - start:.0f} s", flush=True)

        def survives(mutant: Mutant) -> bool:
            tree = trees.get()
            place = tree / MASTER / f"{mutant.module}.py"
            whole = place.read_text(encoding="utf-8")
            try:
                place.write_text(mutant.text, encoding="utf-8")
                return run_tests(tree, mutant.module, limits[mutant.module])
            finally:
                place.write_text(whole, encoding="utf-8")
                trees.put(tree)

        killed = 0
        with ThreadPoolExecutor(options.processes) as workers:
            for i, (mutant, alive) in enumerate(zip(drawn, workers.map(survives, drawn), strict=True), start=1):
                killed += not alive
                if alive:
                    print(f"survived: {mutant}  ({killed} of {i} killed)", flush=True)
    low, high = wilson(killed, len(drawn))
    print(f"{killed} of {len(drawn)} killed: {killed / len(drawn):.1%} ({low:.1%} to {high:.1%})")


if __name__ == "__main__":
    main()
