"""Write runs in the format of another tool: a LeRobotDataset v3.0, one episode each run.

Each row is a cycle; --fps takes a whole divisor of the cycle's rate. Taxels, force, joints, targets and phases become
its columns; the run's own files go along in `raw`, and `canprobe replay` reads them there.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from canprobe.cli.argument_types import folder_path
from canprobe.cli.parser import Parser

HELP = "write runs as a LeRobot dataset"
EXAMPLE = """\
examples:
  canprobe export runs/cylinder-20260901-120000 --lerobot dataset
  canprobe export runs/a runs/b runs/c --lerobot dataset --fps 50
"""


def add_arguments(parser: Parser) -> None:
    parser.add_argument("runs", metavar="RUN", type=Path, nargs="+", help="folder of a run, an episode each")
    parser.add_option("--lerobot DIR", "folder of the dataset; it must not exist", folder_path, required=True)
    parser.add_option("--fps N", "rows a second [the rate of the cycle]", int)


def run(args: argparse.Namespace) -> None:
    """Write the dataset."""
    from canprobe.cell.results.lerobot import export_lerobot

    export_lerobot(args.runs, args.lerobot, fps=args.fps)
    episodes = f"{len(args.runs)} episode{'s' if len(args.runs) > 1 else ''}"
    print(f"wrote {args.lerobot}: {episodes}; the files of each run are in {args.lerobot / 'raw'}")
