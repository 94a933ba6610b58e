"""List the packaged cells and arrays, with the folders of their files, and those that other packages offer."""

from __future__ import annotations

import argparse

from canprobe.cli import scenes

HELP = "list the packaged cells and arrays"
EXAMPLE = """\
examples:
  canprobe cells
  canprobe run cylinder --cell puma560
"""

add_arguments = scenes.add_arguments


def run(args: argparse.Namespace) -> None:
    """Print name and title of every packaged cell and array, and the folders of their files."""
    advice = {
        "cell": "copy one to change it, or let `canprobe init` write one",
        "array": "copy one to change it, and name it in a cell: array in [sensor]",
    }
    return scenes.print_packaged(advice, args)
