"""Run a scene: bring the cell up, carry out the task, stop, and write the results.

On the lockstep bus the emulated nodes run in this process, in virtual time. On any other bus they run in a second
process, in real time.
"""

from __future__ import annotations

import argparse
import contextlib
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from canprobe.cli.output import print_json, print_lines, print_summary
from canprobe.cli.parser import Parser
from canprobe.cli.target import scene_of, with_scene
from canprobe.errors import CanprobeError

HELP = "run a scene and write the results"
EXAMPLE = """\
examples:
  canprobe run cylinder
  canprobe run cylinder --seed 3 --out runs/third --json
  canprobe run cylinder --set task.force_n=3 --set object.radius_mm=50
  canprobe run cylinder --full
  canprobe run cylinder --no-figures
  canprobe run cylinder --only log,bus_log
  canprobe run cylinder --tool runs/calibrate/tool.toml
  canprobe run cylinder --bus socketcan --channel vcan0 --patient
"""


def add_arguments(parser: Parser) -> None:
    parser.add_shared("SCENE", "BUS", "--realtime", "--patient", "--bridge", "--out", "--force", "--seed", "--duration")
    parser.add_option("--tool FILE", "centre of the probe, from the tool.toml of a calibration", Path)
    parser.add_argument(
        "--no-figures",
        dest="figures",
        action="store_false",
        default=None,
        help="draw no report.png and surface.png [the scene's outputs.figures]",
    )
    parser.add_option(
        "--only LIST",
        "outputs to make, of log,truth,surface_map,bus_log,figures; the others are off [the scene's outputs]",
    )
    parser.add_option("--full", "print the error of the force and every estimator too")
    parser.add_shared("--json", "-v")


def run(args: argparse.Namespace) -> None:
    """Run the scene; the verdict goes to stdout, the progress to stderr. A run that was stopped raises.

    It is printed as soon as it holds the estimator in the loop; with --full the errors of the others follow below it.
    """
    scene = scene_of(args)
    if args.tool is not None:
        from canprobe.cell.results.tool_file import with_tool

        scene = with_tool(scene, args.tool)

    from canprobe import api
    from canprobe.cell.planning.bridges import BRIDGES
    from canprobe.cell.results.text import bridge_lines, folder_line, method_lines, summary_text

    folder = api.results_folder(scene, args.out)

    def print_early(summary: Mapping[str, Any]) -> None:
        if not args.json:
            with contextlib.suppress(OSError):  # what follows is printed there too, and then it is reported
                print_summary(with_scene(summary_text({**summary, "bridges": None}, None, full=args.full), args))
                sys.stdout.flush()

    try:
        result = api.run(
            scene,
            out=folder,
            force=args.force,
            progress=args.report.bar(),
            say=args.report.detail,
            bridge=args.bridge,
            early_summary=print_early,
        )
    except CanprobeError as error:
        if args.json and error.summary is not None:
            print_json(error.summary)
        raise
    except KeyboardInterrupt:
        where = f"; results until then: {folder}" if folder.exists() else ""
        args.report.complain(f"canprobe: interrupted, the cell is stopped{where}")
        raise
    if args.json:
        print_json(result.summary)
    else:
        of_others = dict(list(result.summary["shape"].get("methods", {}).items())[1:]) if args.full else {}
        print_lines([*method_lines(of_others), *bridge_lines(result.summary.get("bridges") or {}), *_expected(args)])
        print(folder_line(folder))
        view = BRIDGES["view"]
        print(f"next: {f'{view.pip} && ' if view.missing else ''}canprobe view {shlex.quote(str(folder))}")


def _expected(args: argparse.Namespace) -> list[str]:
    """A line with the expected figures, where a packaged scene ran unchanged."""
    from canprobe.cell.results.expected import expected_text, read_expected, seeds_text

    read = read_expected()
    figures = read["scenes"].get(args.scene)
    if not figures or any(value is not None for value in (args.cell, args.duration, args.tool, args.set or None)):
        return []
    return [f"  expected   {expected_text(figures)} (seeds {seeds_text(read)})"]
