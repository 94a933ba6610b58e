"""List the packaged scenes and print the folder of their files."""

from __future__ import annotations

import argparse

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
    from canprobe.scene.load import packaged_scenes, scenes_folder

    scenes, folder = packaged_scenes(), scenes_folder()
    if args.json:
        paths = (str(folder / f"{name}.toml") for name, _ in scenes)
        print_json(
            [{"name": name, "title": title, "path": path} for (name, title), path in zip(scenes, paths, strict=True)]
        )
    else:
        print_table(scenes)
        print(f"in {folder}; copy one to change it")
    return 0
