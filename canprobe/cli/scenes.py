"""List the packaged scenes, with the figures to expect of them, and those that other packages offer.

The figures are RMS errors of the contact force, and of the curvature that the estimator in the loop reports. Each is
given as the lowest and the highest over several seeds.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from canprobe.cli.output import print_answer, print_table
from canprobe.cli.parser import Parser

HELP = "list the packaged scenes"
EXAMPLE = """\
examples:
  canprobe scenes
  canprobe scenes --json
"""


def add_arguments(parser: Parser) -> None:
    parser.add_shared("--json")


def run(args: argparse.Namespace) -> None:
    """Print name, title and figures of every packaged scene, and the folder of their files."""
    from canprobe.cell.results.expected import read_expected

    return print_packaged({"scene": "copy one to change it"}, args, read_expected())


def print_packaged(
    advice: Mapping[str, str], args: argparse.Namespace, expected: Mapping[str, Any] | None = None
) -> None:
    """Print name and title of every packaged file of some kinds, their folders, and advice.

    Args:
        advice: line of advice for each kind; with scenes the estimators of other packages are listed, too.
        args: arguments of the command.
        expected: expected figures from `read_expected`.
    """
    from canprobe.cell.results.expected import LISTED_FIGURES, expected_text, seeds_text
    from canprobe.cell.scene.load import offered, packaged, packaged_files
    from canprobe.cell.scene.plugins import plugins

    document: list[dict[str, Any]] = []
    for kind, then in advice.items():
        found, paths, others = packaged(kind), packaged_files(f"{kind}s"), offered(kind, args.report.say)
        for name, title in found:
            figures = {} if expected is None else {"expected": expected["scenes"].get(name, {})}
            row = {"kind": kind, "name": name, "title": title, "path": str(paths[name]), "package": "canprobe"}
            document.append({**row, **figures})
        document += [{"kind": kind, **row} for row in others]
        if args.json:
            continue
        if expected is None:
            print_table(found)
        else:
            print_table([(*row, expected_text(expected["scenes"].get(row[0], {}), LISTED_FIGURES)) for row in found])
            print(f"figures: RMS errors to expect, lowest–highest of the seeds {seeds_text(expected)}")
        print(f"in {next(iter(paths.values())).parent}; {then}")
        print_table([(row["name"], row["title"], f"of the package {row['package']}") for row in others])
    estimators = list(plugins("estimator")) if "scene" in advice else []
    document += [{"kind": "estimator", "name": one.name, "package": one.package} for one in estimators]
    rows = [(one.name, f"estimator of the package {one.package}") for one in estimators]
    print_answer(args, document, lambda: print_table(rows))
