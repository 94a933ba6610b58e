"""List the packaged cells and print the folder of their files."""

from __future__ import annotations

import argparse

from canprobe.cli.output import print_json, print_table
from canprobe.cli.parser import Parser, add_options

HELP = "list the packaged cells"
EXAMPLE = """\
examples:
  canprobe cells
  canprobe run cylinder --cell puma560
"""


def add_arguments(parser: Parser) -> None:
    """Add the command's arguments."""
    add_options(parser, "--json")


def run(args: argparse.Namespace) -> int:
    """Print name and title of every packaged cell, and the folder of their files."""
    from canprobe.scene.load import packaged_cells, packaged_files

    cells, paths = packaged_cells(), packaged_files("cells")
    if args.json:
        print_json([{"name": name, "title": title, "path": str(paths[name])} for name, title in cells])
    else:
        print_table(cells)
        print(f"in {next(iter(paths.values())).parent}; copy one to change it, or let `canprobe init` write one")
    return 0
