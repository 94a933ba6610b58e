"""`canprobe study`: measure the estimators against truth, and draw it."""

from __future__ import annotations

import argparse
from pathlib import Path

from canprobe.cli.output import print_json, print_table, say
from canprobe.cli.parser import Commands, Parser, add_json, did_you_mean

_EXAMPLE = """\
example:
  canprobe study --list
  canprobe study estimators --quick --out runs/estimators
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "study", help="measure the estimators against truth", description=__doc__, epilog=_EXAMPLE
    )
    parser.add_argument("name", metavar="NAME", nargs="?", help="which study; see --list")
    parser.add_argument("--list", action="store_true", help="list the studies and leave")
    parser.add_argument("--out", metavar="DIR", type=Path, help="folder for the files; runs/study-NAME by default")
    parser.add_argument("--quick", action="store_true", help="fewer repeats: a first look")
    add_json(parser)
    parser.set_defaults(run=run, complain=parser.error)


def run(args: argparse.Namespace) -> int:
    """Run a study, print its table, write its files."""
    from canprobe.studies.study import STUDIES, run_study

    if args.list:
        if args.json:
            print_json(dict(STUDIES))
        else:
            print_table(list(STUDIES.items()))
        return 0
    if args.name not in STUDIES:
        known = ", ".join(STUDIES)
        wrong = f"unknown study {args.name!r}{did_you_mean(args.name, STUDIES)}" if args.name else "expected NAME"
        args.complain(f"{wrong}; studies: {known}")
    from canprobe.studies.study_files import as_document, text_of, write_study

    result = run_study(args.name, quick=args.quick, say=say)
    paths = write_study(result, args.out or Path("runs") / f"study-{args.name}")
    if args.json:
        print_json(as_document(result))
    else:
        print(text_of(result), end="")
    say("wrote " + ", ".join(map(str, paths)))
    return 0
