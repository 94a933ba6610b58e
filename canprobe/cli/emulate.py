"""`canprobe emulate`: serve a scene's emulated nodes on a bus until Ctrl-C, for any master."""

from __future__ import annotations

import argparse
import contextlib
from pathlib import Path
from typing import TYPE_CHECKING

from canprobe.cli.interrupts import termination_interrupts
from canprobe.cli.output import say
from canprobe.cli.parser import Commands, Parser, add_bus, add_scene, node_ids, whole
from canprobe.cli.target import target_of
from canprobe.errors import UsageError

if TYPE_CHECKING:
    from canprobe.scene import Scene

_EXAMPLE = """\
example:
  canprobe emulate cylinder --channel vcan0
  canprobe emulate cylinder --channel vcan0 --nodes 1-6
  canprobe emulate cylinder --channel vcan0 --store nodes/
"""


def add_parser(commands: Commands[Parser]) -> None:
    """Add the command."""
    parser = commands.add_parser("emulate", help="serve emulated nodes on a bus", description=__doc__, epilog=_EXAMPLE)
    add_scene(parser)
    add_bus(parser)
    parser.add_argument("--nodes", metavar="IDS", type=node_ids, help="such as 1-6,16 [those the scene marks emulated]")
    parser.add_argument("--seed", metavar="N", type=whole(0, 2**63 - 1), help="seed of everything random [the scene's]")
    parser.add_argument(
        "--truth", metavar="FILE", type=Path, help="write the plant's true values there at the end (.npz)"
    )
    parser.add_argument(
        "--store", metavar="DIR", type=Path, help="keep there what a master stores by 1010h [forgotten at the end]"
    )
    parser.add_argument("--parent", metavar="PID", type=whole(1, 2**31 - 1), help=argparse.SUPPRESS)  # ends with it
    parser.set_defaults(run=run, bus="socketcan")


def run(args: argparse.Namespace) -> int:
    """Serve until an interrupt, which is the normal way to leave."""
    from canprobe.scene_loader import load_scene

    scene = load_scene(args.scene)
    if args.channel is None:
        raise UsageError("emulate: --channel is missing: say which bus the nodes are to appear on, such as vcan0")
    target = target_of(args, scene)
    wanted = _nodes(args.nodes, scene)

    from canprobe import api
    from canprobe.child import end_with_parent

    with contextlib.suppress(KeyboardInterrupt), termination_interrupts():
        if args.parent is not None:
            end_with_parent(args.parent)
        api.emulate(
            scene,
            interface=target.interface,
            channel=target.channel,
            bitrate=target.bitrate,
            node_ids=wanted,
            seed=args.seed,
            truth_path=args.truth,
            store_folder=args.store,
            say=say,
        )
    return 0


def _nodes(wanted: tuple[int, ...] | None, scene: Scene) -> tuple[int, ...]:
    known = {*(scene.arm.node_ids if scene.arm else ()), *([scene.sensor.node_id] if scene.sensor else ())}
    if wanted is None:
        wanted = scene.emulated_node_ids
    if missing := sorted(set(wanted) - known):
        raise UsageError(f"--nodes: scene {scene.name} has no node {missing}; it has {sorted(known)}")
    if not wanted:
        raise UsageError(f"scene {scene.name} marks no node as emulated; name some with --nodes")
    return wanted
