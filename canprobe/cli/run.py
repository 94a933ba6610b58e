"""`canprobe run`: carry out a scene and write what was measured."""

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
    add_scene,
    folder_path,
    seconds,
    whole,
)
from canprobe.cli.target import add_patient, add_realtime, target_of, with_patience, with_realtime
from canprobe.errors import CanprobeError

_EXAMPLE = """\
Emulated nodes run in this process on the lockstep bus, and in a process of their own on any other.

examples:
  canprobe run cylinder
  canprobe run cylinder --seed 3 --out runs/third --json
  canprobe run cylinder --bus socketcan --channel vcan0 --patient
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser("run", help="carry out a scene", description=__doc__, epilog=_EXAMPLE)
    add_scene(parser)
    add_bus(parser)
    add_realtime(parser)
    add_patient(parser)
    add_bridge(parser)
    parser.add_argument("--out", metavar="DIR", type=folder_path, help="folder for the results [runs/<scene>-<time>]")
    add_force(parser)
    parser.add_argument("--tool", metavar="FILE", type=Path, help="tool.toml of a calibration, for the probe's centre")
    parser.add_argument("--seed", metavar="N", type=whole(0, 2**63 - 1), help="seed of everything random [the scene's]")
    parser.add_argument(
        "--duration", metavar="S", type=seconds, help="length of the scene's phase, seconds [the scene's]"
    )
    parser.add_argument("--blf", action="store_true", help="write the bus as bus.blf too, when the run is over")
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run the scene; the summary goes to stdout, the progress to stderr. A run that was stopped raises."""
    from canprobe.scene_loader import load_scene

    scene = with_patience(with_realtime(load_scene(args.scene), args.realtime), args.patient)
    if args.tool is not None:
        from canprobe.scene_tool import with_tool

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
        try:
            _write_blf(folder, wanted=args.blf and error.summary is not None)
        except CanprobeError as unwritten:  # what stopped the run counts for more
            error.add_note(str(unwritten))
        raise
    except KeyboardInterrupt:
        where = f"; what was measured until then: {folder}" if folder.exists() else ""
        say(f"canprobe: interrupted, the cell is stopped{where}")
        _write_blf(folder, wanted=args.blf)
        raise
    _write_blf(folder, wanted=args.blf)
    if args.json:
        print_json(result.summary)
    else:
        print(result.text())
    return 0


def _write_blf(folder: Path, *, wanted: bool) -> None:
    """The bus in the other form, where it was recorded."""
    if wanted and (folder / "bus.log").is_file():
        from canprobe.bus.logfile import convert_log

        convert_log(folder / "bus.log", folder / "bus.blf")
