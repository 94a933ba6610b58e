"""`canprobe plan`: what a scene needs on the bus, whether it fits, and what it leaves out."""

from __future__ import annotations

import argparse

from canprobe.cli.output import print_json
from canprobe.cli.parser import Commands, Parser, add_json, add_scene

_EXAMPLE = """\
example:
  canprobe plan cylinder
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "plan", help="show what a scene needs and leaves out", description=__doc__, epilog=_EXAMPLE
    )
    add_scene(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the plan; a scene that does not fit raises PlanError with every reason."""
    from canprobe.planning import make_plan, plan_text
    from canprobe.scene_loader import load_scene

    plan = make_plan(load_scene(args.scene))
    if args.json:
        print_json(plan.as_dict())
    else:
        print(plan_text(plan), end="")
    return 0
