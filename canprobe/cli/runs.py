"""List runs with their size and verdict, compare two, or delete some.

RUN is the folder of a run, or one that holds runs. Two folders of runs are compared: the settings and figures that
differ. --prune deletes what would be listed, after a question. A folder that may belong to a run that goes on, or that
holds anything that no run wrote, stays.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from canprobe.cli.argument_types import folder_path, whole
from canprobe.cli.output import print_answer, print_table, say
from canprobe.cli.parser import Parser
from canprobe.cli.stdin import yes_typed
from canprobe.errors import UsageError

HELP = "list, compare or delete runs"
EXAMPLE = """\
examples:
  canprobe runs
  canprobe runs runs/first runs/second
  canprobe runs --prune --keep 10
  canprobe runs runs/first --prune --yes
"""


def add_arguments(parser: Parser) -> None:
    parser.add_argument("runs", metavar="RUN", type=folder_path, nargs="*", help="folder of a run, or of runs [runs]")
    parser.add_option("--prune", "delete the runs")
    parser.add_option("--keep N", "with --prune: the newest N runs stay [0]", whole(0, 1_000_000), default=0)
    parser.add_option("--yes", "with --prune: do not ask")
    parser.add_shared("--json")


def run(args: argparse.Namespace) -> None:
    """Print the runs, or what differs between two; or delete them."""
    from canprobe.cell.results.runs import compare_runs, find_runs, remove_run

    found = [entry for folder in args.runs or [Path("runs")] for entry in find_runs(folder)]
    if not args.prune and len(args.runs) == len(found) == 2:
        differing = compare_runs(*args.runs)
        print_answer(args, differing, lambda: _print_differing(args.runs, differing))
        return
    if args.prune:
        found = sorted(found, key=lambda entry: entry["started"])[: max(len(found) - args.keep, 0)]
        for entry in found:
            if entry["kept_for"] is not None:
                say(f"{entry['folder']}: stays: {entry['kept_for']}")
        found = [entry for entry in found if entry["kept_for"] is None]
    print_answer(args, found, lambda: _print_runs(found))
    if args.prune and found:
        if not args.yes and not yes_typed(f"delete {_count(found)}?"):
            raise UsageError("runs: --prune needs a yes at the terminal, or --yes; nothing was deleted")
        for entry in found:
            remove_run(Path(entry["folder"]))


def _print_runs(found: Sequence[Mapping[str, Any]]) -> None:
    rows = []
    for one in found:
        length = "" if one["duration_s"] is None else f"{one['duration_s']:.1f} s"
        rows.append((one["folder"], one["scene"], one["started"], length, _size(one["size_bytes"]), one["verdict"]))
    print_table(rows)
    print(f"{_count(found)}, {_size(sum(one['size_bytes'] for one in found))}")


def _count(found: Sequence[object]) -> str:
    return f"{len(found)} run{'s' * (len(found) != 1)}"


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count < 1e9 else f"{count / 1e9:.2f} GB"


def _print_differing(folders: Sequence[Path], differing: Mapping[str, Mapping[str, Sequence[Any]]]) -> None:
    for part, values in differing.items():
        print_table([(part, *map(str, folders)), *((name, *map(str, of_runs)) for name, of_runs in values.items())])
