"""List the postures of a cell, check them, or save the one in which the arm stands.

Postures stand in the cell file, `[postures]`, in degrees or millimetres; `start` is what the joints have as start_deg
or start_mm. `save` keeps the comments of the file. Nothing is moved.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from canprobe.cli.hands import opened
from canprobe.cli.move import standing
from canprobe.cli.output import print_answer, print_table
from canprobe.cli.parser import Parser
from canprobe.cli.target import loaded
from canprobe.errors import UsageError

if TYPE_CHECKING:
    from canprobe.cell.planning.model import Plan

HELP = "list, check or save postures of a cell"
EXAMPLE = """\
examples:
  canprobe posture list puma260
  canprobe posture check cell.toml
  canprobe posture save cell.toml ready --bus socketcan --channel can0
"""


def add_arguments(parser: Parser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True, parser_class=Parser)
    for action, text in (
        ("list", "list the postures"),
        ("check", "check that each posture, and the way from the start to it, keeps all limits"),
        ("save", "save the posture in which the arm stands"),
    ):
        one = actions.add_parser(action, help=text, description=f"{text.capitalize()}.")
        one.add_shared("SCENE")
        if action == "save":
            one.add_argument("name", metavar="NAME", help="name of the posture")
            one.add_shared("BUS", "--realtime", "--patient")
        if action == "list":
            one.add_shared("--json")
        one.add_shared("-v")
        one.set_defaults(run=run, action=action)


def run(args: argparse.Namespace) -> int:
    """Do what ACTION says."""
    if args.action == "save":
        return _save(args)

    from canprobe.cell.planning.make import make_plan
    from canprobe.cell.scene.resolve import resolve

    plan = make_plan(resolve(loaded(args)))
    arm = plan.setup.needed_arm("posture")
    if args.action == "check":
        return _check(plan)
    shown = {
        name: [round(its.shown(value), 3) for its, value in zip(arm.model.joints, q, strict=True)]
        for name, q in arm.postures.items()
    }
    heads = [f"{its.name} ({its.unit})" for its in arm.model.joints]
    table = [["posture", *heads], *([name, *(f"{v:g}" for v in row)] for name, row in shown.items())]
    print_answer(args, shown, lambda: print_table(table))
    return 0


def _check(plan: Plan) -> int:
    """Print what is wrong with each posture; status 2 where something is."""
    from canprobe.cell.tasks.hand_way import joint_way

    arm, wrong = plan.setup.needed_arm(), 0
    for name, q in arm.postures.items():
        try:
            joint_way(plan, arm.q_start, q).whole()
            print(f"{name}: fits")
        except UsageError as error:
            wrong += 1
            print(f"{name}: from the start, {error}")
    return 2 if wrong else 0


def _save(args: argparse.Namespace) -> int:
    """Read where the arm stands, and write it into the cell file."""
    from canprobe.cli.posture_file import postures_file, save_posture

    path = Path(args.cell or args.scene)
    cell = opened(args)
    joints = cell.plan.setup.needed_arm("posture").model.joints
    postures_file(path, args.name)  # what is wrong is told before anything is sent
    with cell:
        measurement = cell.read()
        assert measurement.q is not None
    text = standing(cell.plan, measurement)
    save_posture(path, args.name, joints, measurement.q)
    print(f"{path}: {args.name} is {text}")
    return 0
