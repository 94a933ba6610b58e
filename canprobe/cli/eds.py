"""`canprobe eds`: the packaged EDS files, for other tools and masters."""

from __future__ import annotations

import argparse

from canprobe.cli.output import print_json
from canprobe.cli.parser import Commands, Parser, add_json

_EXAMPLE = """\
examples:
  canprobe eds list
  canprobe eds path puma260_joint
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "eds", help="list the EDS files or show where they are", description=__doc__, epilog=_EXAMPLE
    )
    actions = parser.add_subparsers(metavar="ACTION", required=True, parser_class=Parser)
    listing = actions.add_parser("list", help="list the packaged files", epilog="example:\n  canprobe eds list\n")
    add_json(listing)
    listing.set_defaults(run=run, action="list")
    path = actions.add_parser(
        "path", help="print where one of them is", epilog="example:\n  canprobe eds path puma260_joint\n"
    )
    path.add_argument("name", metavar="NAME", help="name of a packaged file, with or without .eds")
    path.set_defaults(run=run, action="path")


def run(args: argparse.Namespace) -> int:
    """Print the names of the files, or the path of one."""
    from canprobe.eds import eds_names, eds_path

    if args.action == "path":
        print(eds_path(args.name))
    elif args.json:
        print_json(list(eds_names()))
    else:
        print("\n".join(eds_names()))
    return 0
