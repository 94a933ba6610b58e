"""List the packaged cells and arrays, and print the folders of their files."""

from __future__ import annotations

import argparse

from canprobe.cli.output import print_json, print_table
from canprobe.cli.parser import Parser, add_options

HELP = "list the packaged cells and arrays"
EXAMPLE = """\
examples:
  canprobe cells
  canprobe run cylinder --cell puma560
"""


def add_arguments(parser: Parser) -> None:
    """Add the command's arguments."""
    add_options(parser, "--json")


def run(args: argparse.Namespace) -> int:
    """Print name and title of every packaged cell and array, and the folders of their files."""
    from canprobe.scene.load import packaged_arrays, packaged_cells, packaged_files

    found = {"cell": packaged_cells(), "array": packaged_arrays()}
    paths = {kind: packaged_files(f"{kind}s") for kind in found}
    if args.json:
        print_json(
            [
                {"kind": kind, "name": name, "title": title, "path": str(paths[kind][name])}
                for kind, files in found.items()
                for name, title in files
            ]
        )
        return 0
    folders = {kind: next(iter(files.values())).parent for kind, files in paths.items()}
    print_table(found["cell"])
    print(f"in {folders['cell']}; copy one to change it, or let `canprobe init` write one")
    print("arrays, for `array` in [sensor] of a cell:")
    print_table(found["array"])
    print(f"in {folders['array']}; copy one to change it")
    return 0
