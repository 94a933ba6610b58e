"""List the packaged scenes and print the folder of their files."""

from __future__ import annotations

import argparse
from typing import Literal

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
    return print_packaged("scenes", args, "copy one to change it")


def print_packaged(what: Literal["scenes", "cells"], args: argparse.Namespace, advice: str) -> int:
    """Print name and title of every packaged scene or cell, their folder, and what can be done with them."""
    from canprobe.scene.load import packaged_cells, packaged_files, packaged_scenes

    found, paths = packaged_scenes() if what == "scenes" else packaged_cells(), packaged_files(what)
    if args.json:
        print_json([{"name": name, "title": title, "path": str(paths[name])} for name, title in found])
    else:
        print_table(found)
        print(f"in {next(iter(paths.values())).parent}; {advice}")
    return 0
