"""Show what a scene would send on the bus, whether it fits, and what it leaves out. No bus is opened.

A verdict of a few lines comes first; --full adds all tables.

A scene that does not fit is refused with status 2, with every reason and with changes that make it fit. --rehearse also
brings the cell up in lockstep with every node emulated, and carries out the beginning of its task.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from canprobe.cell.session.terminal import columns
from canprobe.cli.output import print_answer, print_json, say
from canprobe.cli.parser import Parser
from canprobe.cli.target import loaded, with_scene
from canprobe.errors import CanprobeError, PlanError, UsageError, needed_module

if TYPE_CHECKING:
    from canprobe.cell.planning.model import Plan

HELP = "show what a scene sends, needs and leaves out"
EXAMPLE = """\
files of --export:
  dcf      a device configuration file for each node
  dbc, kcd every frame with its signals (extra `can`)
  bus.yml  for ros2_canopen and dcfgen, with the EDS files that it names (extra `can`)

--measured ends with status 3 if the log differs from the plan.

examples:
  canprobe plan cylinder
  canprobe plan cylinder --full
  canprobe plan mine.toml --auto
  canprobe plan mine.toml --rehearse
  canprobe plan cylinder --measured runs/cylinder-20260101-120000-000
  canprobe plan cylinder --measured conform.json
  canprobe plan cylinder --export dbc --export dcf --out config/
  canprobe plan cylinder --figure plan.png
"""
EXPORTS = ("dcf", "dbc", "kcd", "bus.yml")


def add_arguments(parser: Parser) -> None:
    parser.add_shared("SCENE")
    parser.add_option("--full", "print the tables of nodes, PDOs, times and choices too")
    parser.add_option(
        "--measured LOG",
        "compare a candump log, the folder of a run, or the --json report of `canprobe conform` with the plan",
        Path,
    )
    parser.add_option(
        "--rehearse",
        "bring the cell up in lockstep, all of it emulated, and touch; status 2 with the cause where that fails",
    )
    parser.add_option(
        "--auto",
        "let the plan choose bus.fd, bus.cob_ids, arm.grouped_rpdo and sensor.channel, except those that the"
        " scene sets",
    )
    parser.add_argument(
        "--export",
        choices=EXPORTS,
        action="append",
        default=[],
        help="write the plan as a file for other tools; may be repeated",
    )
    parser.add_option("--figure FILE.png", "draw the cycles and the response times (extra `study`)", Path)
    parser.add_option("--out DIR", "folder of the exported files [.]", Path, default=Path())
    parser.add_shared("--json")


def _draw(plan: Plan, path: Path) -> Path:
    drawing = needed_module("canprobe.cell.results.plan_figure", "study", "--figure needs matplotlib:")
    if not path.suffix:
        path = path.with_suffix(".png")  # as matplotlib would do without a message
    try:
        drawing.draw_plan(plan, path)
    except ValueError as error:  # matplotlib does not know the format
        raise UsageError(f"--figure {path}: {error}") from error
    return path


def run(args: argparse.Namespace) -> int:
    """Print the plan, or the files that were exported; a scene that does not fit raises PlanError with every reason."""
    from canprobe.cell.planning.free_parameters import opened
    from canprobe.cell.planning.make import make_plan
    from canprobe.cell.planning.report import plan_dict, plan_text, refused_dict, verdict_text
    from canprobe.cell.scene.resolve import resolve

    if args.measured is not None and (args.export or args.figure is not None):
        raise UsageError("plan: --measured compares a log with the plan and writes no --export or --figure")
    if args.measured is not None and args.rehearse:
        raise UsageError("plan: --measured compares a log with the plan and rehearses nothing: leave out one of both")
    scene = loaded(args)
    try:
        setup = resolve(scene)
        plan = make_plan(opened(setup) if args.auto else setup)
        if plan.setup.arm is not None and not all(node.emulated for node in plan.nodes):
            from canprobe.cell.session.joint_record import warned  # which knows the master: only for real drives

            plan = warned(plan)
        plan = replace(plan, warnings=tuple(with_scene(one, args) for one in plan.warnings))
        rehearsed = _rehearse(plan) if args.rehearse else None
    except PlanError as error:
        print_answer(args, refused_dict(scene.name, error.problems, error.ways_out), f"{scene.name}: does not fit")
        raise
    if args.measured is not None:
        return _compare(plan, args.measured, args)
    files = [] if args.figure is None else [_draw(plan, args.figure)]
    if args.export:
        from canprobe.lab.bridge.export import export_plan

        files += export_plan(plan, args.out, args.export)
    if args.json:
        more = {"rehearsed": rehearsed} if rehearsed is not None else {}
        print_json(plan_dict(plan) | more | ({"files": [str(file) for file in files]} if files else {}))
    elif files:
        print("\n".join(str(file) for file in files))
    else:
        print((plan_text if args.full else verdict_text)(plan, columns(sys.stdout)), end="")
    if rehearsed is not None and not args.json:
        print(f"\nrehearsed in lockstep: {rehearsed}")
    return 0


def _rehearse(plan: Plan) -> str:
    """Run the beginning of a plan, all of it emulated; returns its steps in words.

    Raises:
        PlanError: when it did not reach its end.
    """
    from canprobe.cell.session.session import run_beginning

    try:
        session = run_beginning(plan)
    except PlanError:
        raise
    except CanprobeError as error:
        raise PlanError([f"the rehearsal failed ({type(error).__name__}): {error}"]) from error
    task_s = len(session.cell.log) / plan.sync.rate_hz
    return f'{len(plan.nodes)} nodes brought up, then {task_s:.2f} s of task.kind = "{plan.setup.kind}": done'


def _scene_beside(log: Path) -> str | None:
    """Name of the scene that ran, where the log is a run's."""
    from canprobe.cell.recorded.reestimate import scene_of

    try:
        return scene_of(log, log if log.is_dir() else log.parent, None).name
    except CanprobeError:  # none, of another version, or anything
        return None


def _compare(plan: Plan, log: Path, args: argparse.Namespace) -> int:
    """Print the measured traffic of each bus; status 3 where it is not as planned."""
    if log.suffix == ".json":
        from canprobe.cell.results.device_times import read_device_times

        times = read_device_times(log, plan)
        print_answer(args, times.as_dict(), times.text(), end="")
        return 0 if times.as_planned else 3
    from canprobe.cell.results.traffic import measure_traffic

    if (ran := _scene_beside(log)) not in (None, plan.scene.name):
        say(f"canprobe: {log} is a run of scene {ran}, compared with the plan of {plan.scene.name}")
    several = len(plan.buses) > 1
    measured = {bus.channel: measure_traffic(log, plan, channel=bus.channel if several else None) for bus in plan.buses}
    text = "\n".join(f"bus {channel}, {one.text()}" for channel, one in measured.items())
    print_answer(args, {channel: one.as_dict() for channel, one in measured.items()}, text, end="")
    return 0 if all(one.as_planned for one in measured.values()) else 3
