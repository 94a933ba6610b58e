"""List the packaged cells and print the folder of their files."""

from __future__ import annotations

import argparse

from canprobe.cli import scenes

HELP = "list the packaged cells"
EXAMPLE = """\
examples:
  canprobe cells
  canprobe run cylinder --cell puma560
"""

add_arguments = scenes.add_arguments


def run(args: argparse.Namespace) -> int:
    """Print name and title of every packaged cell, and the folder of their files."""
    return scenes.print_packaged("cells", args, "copy one to change it, or let `canprobe init` write one")
