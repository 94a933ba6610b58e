"""`canprobe plan`: what a scene needs on the bus, whether it fits, and what it leaves out."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from canprobe.cli.output import print_json
from canprobe.cli.parser import Commands, Parser, add_json, add_scene

if TYPE_CHECKING:
    from canprobe.planning import Plan

_EXAMPLE = """\
examples:
  canprobe plan cylinder
  canprobe plan cylinder --measured runs/cylinder-20260101-120000
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser(
        "plan", help="show what a scene needs and leaves out", description=__doc__, epilog=_EXAMPLE
    )
    add_scene(parser)
    parser.add_argument(
        "--measured", metavar="LOG", type=Path, help="set a candump log or a run's folder beside the plan instead"
    )
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print the plan; a scene that does not fit raises PlanError with every reason."""
    from canprobe.planning import make_plan, plan_text
    from canprobe.scene_loader import load_scene

    plan = make_plan(load_scene(args.scene))
    if args.measured is not None:
        return _compare(plan, args.measured, args.json)
    if args.json:
        print_json(plan.as_dict())
    else:
        print(plan_text(plan), end="")
    return 0


def _compare(plan: Plan, log: Path, as_json: bool) -> int:
    """Print what was measured; 3 where it is not what was planned."""
    from canprobe.traffic_log import measure_traffic

    measured = measure_traffic(log, plan)
    if as_json:
        print_json(measured.as_dict())
    else:
        print(measured.text(), end="")
    return 0 if measured.as_planned else 3
