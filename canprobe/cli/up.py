"""Bring the cell up, hold and supervise it until Ctrl-C, then stop it safely.

The drives hold their positions. A SocketCAN interface is checked before anything is sent.
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from canprobe.cli.output import left_by_ctrl_c, say
from canprobe.cli.parser import (
    Commands,
    Parser,
    Target,
    add_bridge,
    add_bus,
    add_patient,
    add_realtime,
    add_scene,
    target_of,
    with_patience,
    with_realtime,
)
from canprobe.errors import UsageError

if TYPE_CHECKING:
    from canprobe.scene.model import Scene

_EXAMPLE = """\
examples:
  canprobe up free --bus socketcan --channel can0
  canprobe up free --bus socketcan --channel can0 --check-joints
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser("up", help="bring the cell up and hold it", description=__doc__, epilog=_EXAMPLE)
    add_scene(parser)
    add_bus(parser)
    add_realtime(parser)
    add_patient(parser)
    add_bridge(parser)
    parser.add_argument(
        "--check-joints",
        action="store_true",
        help="turn one joint after the other by 1 deg and back, compare the encoders, and end; asks before each motion",
    )
    parser.add_argument("--yes", action="store_true", help="with --check-joints: do not ask")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Hold the cell until Ctrl-C, which is the normal way to leave."""
    if args.yes and not args.check_joints:
        raise UsageError("up: --yes goes with --check-joints")
    if args.bridge and args.check_joints:
        raise UsageError("up: --check-joints feeds no --bridge")
    from canprobe.scene.load import load_scene

    scene = with_patience(with_realtime(load_scene(args.scene), args.realtime), args.patient)
    target = target_of(args, scene)
    if args.check_joints:
        return _check_joints(scene, target, ask=not args.yes)

    from canprobe import api

    with left_by_ctrl_c():
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


def _check_joints(scene: Scene, target: Target, *, ask: bool) -> int:
    if ask and not sys.stdin.isatty():
        raise UsageError("up --check-joints asks before each motion and needs a terminal; --yes asks nobody")

    from canprobe import api
    from canprobe.cli.operator import TerminalOperator

    api.check_joints(
        scene,
        interface=target.interface,
        channel=target.channel,
        sensor_channel=target.sensor_channel,
        bitrate=target.bitrate,
        operator=TerminalOperator() if ask else None,
        say=say,
    )
    return 0
