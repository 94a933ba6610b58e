"""Run a scene: bring the cell up, carry out the task, stop, and write the results.

On the lockstep bus the emulated nodes run in this process, in virtual time. On any other bus they run in a second
process, in real time.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from canprobe.cli.output import print_json, progress_bar, say, say_on_terminal
from canprobe.cli.parser import (
    Commands,
    Parser,
    add_bridge,
    add_bus,
    add_force,
    add_json,
    add_patient,
    add_realtime,
    add_scene,
    folder_path,
    seconds,
    target_of,
    whole,
    with_patience,
    with_realtime,
)
from canprobe.errors import CanprobeError

_EXAMPLE = """\
examples:
  canprobe run cylinder
  canprobe run cylinder --seed 3 --out runs/third --json
  canprobe run cylinder --tool runs/calibrate/tool.toml
  canprobe run cylinder --bus socketcan --channel vcan0 --patient
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser("run", help="run a scene and write the results", description=__doc__, epilog=_EXAMPLE)
    add_scene(parser)
    add_bus(parser)
    add_realtime(parser)
    add_patient(parser)
    add_bridge(parser)
    parser.add_argument("--out", metavar="DIR", type=folder_path, help="folder of the results [runs/<scene>-<time>]")
    add_force(parser)
    parser.add_argument(
        "--tool", metavar="FILE", type=Path, help="centre of the probe, from the tool.toml of a calibration"
    )
    parser.add_argument(
        "--seed", metavar="N", type=whole(0, 2**63 - 1), help="seed of all random numbers [the scene's]"
    )
    parser.add_argument(
        "--duration",
        metavar="S",
        type=seconds,
        help="length of the scan, press, listen or free phase in seconds [the scene's]",
    )
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the scene; the summary goes to stdout, the progress to stderr. A run that was stopped raises."""
    from canprobe.scene.load import load_scene

    scene = with_patience(with_realtime(load_scene(args.scene), args.realtime), args.patient)
    if args.tool is not None:
        from canprobe.scene.geometry import with_tool

        scene = with_tool(scene, args.tool)
    target = target_of(args, scene)

    from canprobe import api

    folder = api.results_folder(scene, args.out)
    try:
        result = api.run(
            scene,
            interface=target.interface,
            channel=target.channel,
            sensor_channel=target.sensor_channel,
            bitrate=target.bitrate,
            out=folder,
            seed=args.seed,
            duration_s=args.duration,
            force=args.force,
            progress=progress_bar(),
            say=say_on_terminal,
            bridge=args.bridge or (),
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
