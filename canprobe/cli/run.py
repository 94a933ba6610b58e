"""Run a scene: bring the cell up, carry out the task, stop, and write the results.

On the lockstep bus the emulated nodes run in this process, in virtual time. On any other bus they run in a second
process, in real time.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from canprobe.cli.output import print_json, say, say_on_terminal
from canprobe.cli.parser import BUS, Parser, add_options, add_scene, scene_of
from canprobe.errors import CanprobeError
from canprobe.session.progress import progress_bar

HELP = "run a scene and write the results"
EXAMPLE = """\
examples:
  canprobe run cylinder
  canprobe run cylinder --seed 3 --out runs/third --json
  canprobe run cylinder --set task.force_n=3 --set object.radius_mm=50
  canprobe run cylinder --tool runs/calibrate/tool.toml
  canprobe run cylinder --bus socketcan --channel vcan0 --patient
"""


def add_arguments(parser: Parser) -> None:
    """Add the command's arguments."""
    add_scene(parser)
    add_options(parser, *BUS, "--realtime", "--patient", "--bridge", "--out", "--force", "--seed", "--duration")
    parser.add_argument(
        "--tool", metavar="FILE", type=Path, help="centre of the probe, from the tool.toml of a calibration"
    )
    add_options(parser, "--json")


def run(args: argparse.Namespace) -> int:
    """Run the scene; the summary goes to stdout, the progress to stderr. A run that was stopped raises."""
    scene = scene_of(args)
    if args.tool is not None:
        from canprobe.scene.geometry import with_tool

        scene = with_tool(scene, args.tool)

    from canprobe import api

    folder = api.results_folder(scene, args.out)
    try:
        result = api.run(
            scene,
            out=folder,
            seed=args.seed,
            duration_s=args.duration,
            force=args.force,
            progress=progress_bar(),
            say=say_on_terminal,
            bridge=args.bridge,
        )
    except CanprobeError as error:
        if args.json and error.summary is not None:
            print_json(error.summary)
        raise
    except KeyboardInterrupt:
        where = f"; what was measured until then: {folder}" if folder.exists() else ""
        say(f"canprobe: interrupted, the cell is stopped{where}")
        raise
    if args.json:
        print_json(result.summary)
    else:
        print(result.text())
    return 0
