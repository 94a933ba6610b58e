"""Move the arm to a posture, or one joint by a way, and stop it safely.

All joints begin and end together, as fast as their limits of speed, acceleration and jerk allow, times --speed. The way
is looked at as a whole before: joint limits, workspace, and what `[keep_out]` names. Ctrl-C, a closed terminal and the
end of a pipe at stdin brake the motion. A force from `limits.jog_force_n` on ends it, and the probe goes back.
"""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING

from canprobe.cli.argument_types import number_type
from canprobe.cli.hands import add_arguments_of_hands, agreed, opened
from canprobe.cli.parser import Parser
from canprobe.cli.stdin import InputOpen
from canprobe.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy.typing as npt

    from canprobe.cell.master.controller import Measurement
    from canprobe.cell.planning.model import Plan
    from canprobe.cell.tasks.hand_way import HandWay
    from canprobe.mechanics.types import Floats

HELP = "move the arm to a posture, or one joint by a way"
EXAMPLE = """\
examples:
  canprobe move puma260 start
  canprobe move cell.toml ready --bus socketcan --channel can0 --speed 20%
  canprobe move cell.toml --joint 3 --by 5deg
  canprobe move cell.toml -90,65,15,0,100,0 --dry-run
"""
_WAY = re.compile(r"([+-]?\d+(?:\.\d*)?)(deg|mm)?")


def add_arguments(parser: Parser) -> None:
    parser.takes_ways, parser.late = True, "to"
    parser.add_shared("SCENE")
    parser.add_argument(
        "to",
        metavar="TO",
        nargs="?",
        help="name of a posture (`canprobe posture list`), or the positions of all joints, deg or mm, with commas",
    )
    parser.add_option("--joint N", "move this joint alone, by its number from 1", int)
    parser.add_option("--by WAY", "its way, such as 5deg or -10mm", way)
    parser.add_option("--speed SHARE", "share of the speed limits, such as 20%% [10%%]", share, default=0.1)
    parser.add_option("--dry-run", "show the way, and move nothing")
    add_arguments_of_hands(parser)


def way(text: str) -> tuple[float, str | None]:
    """An argument type: a number with deg or mm."""
    if (match := _WAY.fullmatch(text.replace("°", "deg").replace(" ", ""))) is None:
        raise argparse.ArgumentTypeError(f"expected a way such as 5deg or -10mm, got {text!r}")
    return float(match[1]), match[2]


share = number_type(
    lambda text: float(text.removesuffix("%")) * (0.01 if text.endswith("%") else 1.0),
    lambda value: 0.0 < value <= 1.0,
    "a share such as 20% or 0.2, above 0 and up to 1",
)
"""An argument type: a share, in percent or as a number up to 1."""


def run(args: argparse.Namespace) -> None:
    """Show the way, ask, and go it."""
    if (args.joint is None) != (args.by is None) or (args.to is None) == (args.joint is None):
        raise UsageError("move: expected a posture, or --joint and --by; `canprobe posture list CELL` has the postures")
    args.yes = args.yes or args.dry_run
    stdin = InputOpen()
    cell = opened(args)
    goal = _goal(args, cell.plan)  # what is wrong in it is told before anything is sent
    with cell:
        q = cell.read().q
        assert q is not None
        found = cell.way_to(goal(q), args.speed)
        print(described(cell.plan, found, args.speed))
        args.report.say(f"{cell.plan.setup.needed_arm().left_alone}; they are at the end")
        if args.dry_run or not agreed(args, cell, "move?"):
            args.report.say("nothing was moved")
            return
        if not stdin.watched:
            args.report.say("Ctrl-C brakes the motion")
        ended = cell.move(found, wanted=stdin)
        print(f"the arm stands at {standing(cell.plan, cell.read())}")
    if ended is not None:
        args.report.say("warning: stdin has ended, and the motion was braked")


def _goal(args: argparse.Namespace, plan: Plan) -> Callable[[Floats], npt.ArrayLike]:
    """The posture of the command line: where the joints (n,), rad or m, go from where they stand."""
    from canprobe.cell.tasks.hand_way import goal_of

    joints = plan.setup.needed_arm("move").model.joints
    if args.joint is None:
        posture = goal_of(plan, positions_of(plan, args.to))
        return lambda _: posture
    if not 1 <= args.joint <= len(joints):
        raise UsageError(f"move: --joint {args.joint}: the arm has joints 1 to {len(joints)}")
    its, (number, unit) = joints[args.joint - 1], args.by
    if unit not in (None, its.unit):
        raise UsageError(f"move: --by {number:g}{unit}: joint {args.joint} moves in {its.unit}")
    way = number / its.shown(1.0)
    return lambda q: [value + way * (i == args.joint) for i, value in enumerate(q, start=1)]


def positions_of(plan: Plan, text: str) -> str | list[float]:
    """Joint positions, rad or m, of a text with commas; another text is the name of a posture.

    Raises:
        UsageError: they are not as many as the joints.
    """
    joints = plan.setup.needed_arm().model.joints
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        return text
    if len(numbers) != len(joints):
        raise UsageError(f"move: expected positions of {len(joints)} joints, got {len(numbers)}: {text}")
    return [number / joint.shown(1.0) for number, joint in zip(numbers, joints, strict=True)]


def described(plan: Plan, found: HandWay, speed: float) -> str:
    """The way in words: what each joint does, and how long it takes."""
    joints = plan.setup.needed_arm().model.joints
    start, end, duration_s = found.q[0], found.q[-1], found.profile().duration_s
    lines = [
        f"  joint {i + 1}: {its.shown(start[i]):.2f} to {its.text(end[i], '.2f')} ({its.shown(end[i] - start[i]):+.2f})"
        for i, its in enumerate(joints)
    ]
    places = ", ".join(f"{1e3 * value:.0f}" for value in found.tip[-1])
    slowed = f"; {found.slowed_by}" if found.slowed_by else ""
    head = f"the way: {duration_s:.1f} s at {100 * speed:g} % of the speed limits{slowed}"
    return "\n".join([head, *lines, f"  {plan.setup.probe.tip} comes to {places} mm"])


def standing(plan: Plan, measurement: Measurement) -> str:
    """Where the arm stands, in deg or mm."""
    joints, q = plan.setup.needed_arm().model.joints, measurement.q
    assert q is not None
    return ", ".join(its.text(value, ".2f") for its, value in zip(joints, q, strict=True))
