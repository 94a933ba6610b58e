"""Mutation testing: small changes of the package, one at a time, that some test notices. It needs pytest-cov.

    python tests/support/mutants.py --seed 1 --count 300 --record /tmp/reach.json
    python tests/support/mutants.py --all --seed 1 --count 300 --record /tmp/reach.json

A mutant is one changed place of one module, in a copy of the tree: a comparison, a condition, a boolean, a number, a
sum, a returned value, a call whose result is not used. What is no behaviour is not changed: annotations, how
dataclasses are made, texts. The tests run once without a mutant, and it is recorded which of them run which lines, and
for how long. A mutant then meets the tests that run its line, the quickest first, as many as fit into a time. It is
killed where one fails or does not end; where no test runs its line it survives. Survivors are printed with their line,
and the share that was killed with its interval of 95 % (Wilson). Without --all only modules that keep an arm safe are
changed, and only the tests next to them are run. Not part of CI: it takes an hour.
"""

from __future__ import annotations

import argparse
import ast
import json
import math
import multiprocessing
import os
import random
import re
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import entry_points
from itertools import accumulate
from pathlib import Path
from typing import Any

import can  # noqa: F401  what most tests import is loaded once: each mutant runs in a fork
import canopen  # noqa: F401
import pytest
import scipy.optimize
import scipy.spatial  # noqa: F401
from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[2]
MASTER_MODULES = (
    *("lift_off", "supervisor", "supervision", "conditions", "drives", "bringup", "node_bringup", "homing"),
    *("watch", "cycle", "supervised_cycle", "arm_power", "cell"),
    *("following", "position_track", "trail", "image_witness", "push_witness"),
)
SAFETY_MODULES = (
    *(f"canprobe/cell/master/{name}.py" for name in MASTER_MODULES),
    *("canprobe/cell/planning/contact.py", "canprobe/cell/session/recovery.py", "canprobe/cell/tasks/paused.py"),
    *("canprobe/mechanics/touch/depth_witness.py", "canprobe/mechanics/touch/sinkage.py"),
)
PACKAGE = ("canprobe", "bridge", "eds")
COVERAGE = "[run]\nsource = .\nomit = tests/*\n"
INTEGRATION = (
    "lift_off",
    "recovery",
    "supervision",
    "preload",
    "mixed_nodes",
    "troubled_wire",
    "overruns",
    "two_buses",
    "blind_array",
    "way_back",
)
SAFETY_TESTS = (
    *("tests/cell/master", "tests/cell/planning", "tests/cell/tasks/test_paused.py"),
    "tests/mechanics/touch/test_depth_witness.py",
    *("tests/cell/session/test_up.py", "tests/cell/session/test_recovery.py"),
    *(f"tests/cell/integration/test_{name}.py" for name in INTEGRATION),
)
COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
SUMS = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.BitAnd: ast.BitOr}
MOST_TESTS = 40
"""Most tests that are recorded for a line, the quickest of all."""
LEAST_TIMEOUT_S = 30
"""Shortest time, s, after which a test that does not end has failed."""


@dataclass(frozen=True)
class Mutant:
    """One change of a module.

    Attributes:
        node, change: number of the node in `ast.walk`, and of the change among those of the node.
        lines: lines of which a test that meets the change runs one; empty where the change acts on import.
        names: names that such a change gives another value.
    """

    module: str
    node: int
    change: int
    line: int
    what: str
    lines: tuple[int, ...]
    names: frozenset[str]

    def __str__(self) -> str:
        return f"{self.module}:{self.line}: {self.what}"

    def text(self) -> str:
        """The module's text with the change."""
        tree = parse(self.module)
        list(_changes(list(ast.walk(tree))[self.node]))[self.change][1]()
        return ast.unparse(ast.fix_missing_locations(tree))


def parse(module: str) -> ast.Module:
    """The syntax tree of a module."""
    return ast.parse((ROOT / module).read_text(encoding="utf-8"))


def mutants_of(module: str) -> Iterator[Mutant]:
    """Every mutant of a module."""
    nodes = list(ast.walk(parse(module)))  # the outer ones come first
    left_out = {id(part) for node in nodes for root in _no_behaviour(node) for part in ast.walk(root)}
    statements = {id(part): node for node in nodes if isinstance(node, ast.stmt) for part in ast.walk(node)}
    bodies = [body for node in nodes if isinstance(node, ast.FunctionDef) for body in node.body]
    bodies += [node.body for node in nodes if isinstance(node, ast.Lambda)]
    called = {id(part) for body in bodies for part in ast.walk(body)}
    for number, node in enumerate(nodes):
        if id(node) in left_out:
            continue
        for change, (what, _) in enumerate(_changes(node)):
            statement, names = statements[id(node)], frozenset[str]()
            lines = (statement.lineno, *range(node.lineno, node.end_lineno + 1))
            if id(node) not in called:
                made = (one.id for one in ast.walk(statement) if _is_name(one, ast.Store))
                names = frozenset((statement.name,) if isinstance(statement, ast.FunctionDef) else made)
                lines = ()
            yield Mutant(module, number, change, node.lineno, what, lines, names)


def _is_name(node: ast.AST, context: type[ast.expr_context]) -> bool:
    return isinstance(node, ast.Name) and isinstance(node.ctx, context)


def _no_behaviour(node: ast.AST) -> Iterator[ast.AST]:
    hints = [getattr(node, name, None) for name in ("annotation", "returns")]
    yield from (hint for hint in hints if isinstance(hint, ast.AST))
    yield from (one for one in getattr(node, "decorator_list", ()) if ast.unparse(one).startswith("dataclass"))
    if isinstance(node, ast.JoinedStr) or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
        yield node


def _changes(node: Any) -> Iterator[tuple[str, Callable[[], object]]]:
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
    if isinstance(node, ast.Return) and node.value is not None and ast.unparse(node.value) != "None":
        yield f"return None, not `{ast.unparse(node.value)[:60]}`", lambda: setattr(node, "value", ast.Constant(None))
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        yield f"without `{ast.unparse(node)[:60]}`", lambda: setattr(node, "value", ast.Constant(None))


class Seconds:
    """How long each test takes, infinite where it does not pass; a plugin of pytest that writes it down."""

    def __init__(self) -> None:
        self._of: dict[str, float] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add a part of a test."""
        duration = report.duration if report.passed else math.inf
        self._of[report.nodeid] = self._of.get(report.nodeid, 0.0) + duration

    def pytest_sessionfinish(self) -> None:
        """Write the times."""
        Path("seconds.json").write_text(json.dumps(self._of), encoding="utf-8")


class Tree:
    """A copy of the repository, in which one module is changed and tests run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        ignored = shutil.ignore_patterns(".git", ".venv", "runs", "site", ".*_cache")
        shutil.copytree(ROOT, folder, symlinks=True, ignore=ignored)

    def record(self, tests: Iterable[str]) -> dict[str, Any]:
        """Run tests; return their times, and which of them run which line."""
        (self.folder / ".coveragerc").write_text(COVERAGE, encoding="utf-8")
        self.run(["--cov", "--cov-context=test", "--cov-report=", *tests], 180, 7200, Seconds())
        data = CoverageData(str(self.folder / ".coverage"))
        data.read()
        seconds = json.loads((self.folder / "seconds.json").read_text(encoding="utf-8"))
        reached = {}
        for path in data.measured_files():
            for line, contexts in data.contexts_by_lineno(path).items():
                found = sorted((one.rpartition("|")[0] for one in contexts if one), key=seconds.__getitem__)
                reached[f"{Path(path).relative_to(self.folder)}:{line}"] = found[:MOST_TESTS]
        return {"seconds": seconds, "tests": reached}

    def kills(self, number: int, mutant: Mutant, tests: dict[str, float]) -> str | None:
        """The test that notices a mutant; None where all pass. The tests come with their times."""
        place = self.folder / mutant.module
        place.write_text(mutant.text(), encoding="utf-8")
        os.utime(place, (number, number))  # or Python would take the compiled file of another mutant for it
        try:
            return self.run(tests, LEAST_TIMEOUT_S + 10 * max(tests.values()), 60 + 10 * sum(tests.values()))
        finally:
            shutil.copy2(ROOT / mutant.module, place)

    def run(self, tests: Iterable[str], test_s: float, all_s: float, *plugins: object) -> str | None:
        """Run tests in a fork, without a plugin until one fails; what failed or did not end, None where none did."""
        child = multiprocessing.get_context("fork").Process(target=self._run, args=(tests, test_s, plugins))
        child.start()
        child.join(all_s)
        if child.exitcode is None:
            os.killpg(child.pid or 0, signal.SIGKILL)
            return "no end"
        if child.exitcode == 0:
            return None
        failed = re.findall("^(?:FAILED|ERROR) (.*)", (self.folder / "out.txt").read_text(encoding="utf-8"), re.M)
        return failed[0] if failed else f"pytest ends with {child.exitcode}"

    def _run(self, tests: Iterable[str], test_s: float, plugins: tuple[object, ...]) -> None:
        os.setsid()
        os.chdir(self.folder)
        os.environ.update(PYTHONPATH=str(self.folder), CI="1")
        sys.path.insert(0, str(self.folder))
        with open("out.txt", "w", encoding="utf-8") as out:
            os.dup2(out.fileno(), 1)
            os.dup2(out.fileno(), 2)
        first = [] if plugins else ["-x", "-n0"]
        options = ["-q", "--tb=no", "-m", "not vcan and not slow", "-o", f"timeout={test_s:.0f}", *first]
        options += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # plugins are loaded already
        sys.exit(pytest.main([*options, *tests], plugins=plugins))


class Choice:
    """Which tests a mutant meets.

    Args:
        record: what `Tree.record` has found.
        modules: paths of the modules.
        limit_s: longest time of the tests of one mutant.
    """

    def __init__(self, record: dict[str, Any], modules: Iterable[str], limit_s: float) -> None:
        self._seconds, self._tests, self._limit_s = record["seconds"], record["tests"], limit_s
        self._uses: dict[tuple[str, str], set[str]] = {}
        for module in modules:
            for node in ast.walk(parse(module)):
                if _is_name(node, ast.Load) or isinstance(node, ast.Attribute):
                    name = node.id if isinstance(node, ast.Name) else node.attr
                    self._uses.setdefault((module, name), set()).add(f"{module}:{node.lineno}")

    def tests(self, mutant: Mutant) -> dict[str, float]:
        """The quickest tests that meet a mutant, with their times."""
        lines = {f"{mutant.module}:{line}" for line in mutant.lines}
        for name in mutant.names:
            lines |= self._uses.get((mutant.module, name), set()) & self._tests.keys()
        found = {test for line in lines for test in self._tests.get(line, ())} if lines else self._all(mutant.module)
        ordered = sorted(found, key=self._seconds.__getitem__)
        ends_s = accumulate(self._seconds[test] for test in ordered)
        return {
            test: self._seconds[test] for test, end_s in zip(ordered, ends_s, strict=True) if end_s <= self._limit_s
        }

    def _all(self, module: str) -> set[str]:
        """All tests of the files in which a test runs a line of a module: they import it."""
        reached = (tests for line, tests in self._tests.items() if line.startswith(f"{module}:"))
        files = {test.partition("::")[0] for tests in reached for test in tests}
        return {test for test in self._seconds if test.partition("::")[0] in files}


def package_modules() -> Iterator[str]:
    """Every module of the package, without those of links."""
    for folder in PACKAGE:
        for place, _, names in sorted(os.walk(ROOT / folder)):
            yield from (str(Path(place, name).relative_to(ROOT)) for name in sorted(names) if name.endswith(".py"))


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
    parser.add_argument("--all", action="store_true", help="change every module of the package, and run all tests")
    parser.add_argument(
        "--limit", type=float, default=15.0, help="longest processor time of the tests of one mutant, s"
    )
    parser.add_argument("--record", type=Path, help="file that keeps which test runs which line, for the next time")
    parser.add_argument("--again", type=int, nargs="+", help="numbers of single mutants of the draw")
    options = parser.parse_args()
    for plugin in entry_points(group="pytest11"):
        if not plugin.value.startswith("canprobe"):
            plugin.load()
    modules, tests = SAFETY_MODULES, SAFETY_TESTS
    if options.all:
        modules, tests = tuple(package_modules()), ("tests",)
    pool = [mutant for module in modules for mutant in mutants_of(module)]
    drawn = dict(enumerate(random.Random(options.seed).sample(pool, min(options.count, len(pool))), start=1))
    print(f"seed {options.seed}: {len(drawn)} of {len(pool)} mutants of {len(modules)} modules", flush=True)
    drawn = {number: mutant for number, mutant in drawn.items() if number in (options.again or drawn)}
    with tempfile.TemporaryDirectory() as folder:
        tree = Tree(Path(folder) / "tree")
        if options.record is None or not options.record.exists():
            record = tree.record(tests)
            if options.record is not None:
                options.record.write_text(json.dumps(record), encoding="utf-8")
        else:
            record = json.loads(options.record.read_text(encoding="utf-8"))
            if tree.run(["--collect-only", *record["seconds"]], 180, 600):
                sys.exit("the record names tests that are not there: remove it")
        left_out = sum(seconds == math.inf for seconds in record["seconds"].values())
        print(f"{len(record['seconds'])} tests, and {left_out} of them left out, as they do not pass", flush=True)
        choice, killed = Choice(record, modules, options.limit), 0
        for tried, (number, mutant) in enumerate(drawn.items(), start=1):
            near = choice.tests(mutant)
            by = tree.kills(number, mutant, near) if near else None
            killed += by is not None
            fate = f"killed by {by}" if by is not None else f"SURVIVED {len(near)} tests"
            print(f"{number}: {mutant}: {fate} ({killed} of {tried} killed)", flush=True)
    low, high = wilson(killed, len(drawn))
    print(f"{killed} of {len(drawn)} killed: {killed / len(drawn):.1%} ({low:.1%} to {high:.1%})")


if __name__ == "__main__":
    main()
