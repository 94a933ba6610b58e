"""`canprobe up`: bring the cell up, hold and supervise it until Ctrl-C, then stop it safely."""

from __future__ import annotations

import argparse
import contextlib

from canprobe.cli.interrupts import termination_interrupts
from canprobe.cli.output import say
from canprobe.cli.parser import Commands, Parser, add_bridge, add_bus, add_scene
from canprobe.cli.target import add_realtime, target_of, with_realtime

_EXAMPLE = """\
example:
  canprobe up free --bus socketcan --channel can0
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser("up", help="bring the cell up and hold it", description=__doc__, epilog=_EXAMPLE)
    add_scene(parser)
    add_bus(parser)
    add_realtime(parser)
    add_bridge(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Hold the cell until an interrupt, which is the normal way to leave."""
    from canprobe.scene_loader import load_scene

    scene = with_realtime(load_scene(args.scene), args.realtime)
    target = target_of(args, scene)

    from canprobe import api

    with contextlib.suppress(KeyboardInterrupt), termination_interrupts():
        api.up(
            scene,
            interface=target.interface,
            channel=target.channel,
            sensor_channel=target.sensor_channel,
            bitrate=target.bitrate,
            say=say,
            bridge=args.bridge or (),
        )
    return 0
