"""`canprobe scenes`: the packaged scenes."""

from __future__ import annotations

import argparse

from canprobe.cli.output import print_json, print_table
from canprobe.cli.parser import Commands, Parser, add_json

_EXAMPLE = """\
example:
  canprobe scenes
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser("scenes", help="list the packaged scenes", description=__doc__, epilog=_EXAMPLE)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print name and title of every packaged scene."""
    from canprobe.scene_loader import packaged_scenes

    scenes = packaged_scenes()
    if args.json:
        print_json([{"name": name, "title": title} for name, title in scenes])
    else:
        print_table(scenes)
    return 0
