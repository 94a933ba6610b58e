"""List the packaged scenes and print the folder of their files."""

from __future__ import annotations

import argparse
from collections.abc import Mapping

from canprobe.cli.output import print_json, print_table
from canprobe.cli.parser import Parser, add_options

HELP = "list the packaged scenes"
EXAMPLE = """\
examples:
  canprobe scenes
  canprobe scenes --json
"""


def add_arguments(parser: Parser) -> None:
    """Add the command's arguments."""
    add_options(parser, "--json")


def run(args: argparse.Namespace) -> int:
    """Print name and title of every packaged scene, and the folder of their files."""
    return print_packaged({"scene": "copy one to change it"}, args)


def print_packaged(advice: Mapping[str, str], args: argparse.Namespace) -> int:
    """Print name and title of every packaged file of some kinds, their folders, and what can be done with them."""
    from canprobe.scene.load import packaged_arrays, packaged_cells, packaged_files, packaged_scenes

    titles = {"scene": packaged_scenes, "cell": packaged_cells, "array": packaged_arrays}
    document: list[dict[str, str]] = []
    for kind, then in advice.items():
        found, paths = titles[kind](), packaged_files(f"{kind}s")
        if args.json:
            document += [{"kind": kind, "name": n, "title": title, "path": str(paths[n])} for n, title in found]
        else:
            print_table(found)
            print(f"in {next(iter(paths.values())).parent}; {then}")
    if args.json:
        print_json(document)
    return 0
