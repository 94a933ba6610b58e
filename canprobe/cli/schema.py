"""Print the JSON Schema of scene, cell or array files, with which an editor completes, explains and checks keys.

`canprobe init` writes the schemas of its two files beside them; for other files send the output into a file. `canprobe
plan` checks more than a schema can say: what several numbers mean together, the files that are named, and whether the
cell can do it.
"""

from __future__ import annotations

import argparse

from canprobe.cell.scene.schemas import KINDS, schema_text
from canprobe.cli.parser import Parser

HELP = "print the JSON Schema of scene, cell or array files"
EXAMPLE = """\
examples:
  canprobe schema scene
  canprobe schema cell
"""


def add_arguments(parser: Parser) -> None:
    parser.add_argument("kind", metavar="KIND", choices=KINDS, help=f"kind of file: {', '.join(KINDS)}")


def run(args: argparse.Namespace) -> None:
    """Print the schema."""
    print(schema_text(args.kind), end="")
