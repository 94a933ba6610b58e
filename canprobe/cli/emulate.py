"""Serve emulated nodes on a bus until Ctrl-C, for any CANopen master.

With a SCENE the nodes are its arm and array, and a model of the arm and the contact moves them. With --eds each file is
one node: it answers with the values of the file; where the file describes a CiA 402 drive, it moves an ideal axis.
Each --motor is one that speaks the protocol of its maker, alone or beside such nodes.
"""

from __future__ import annotations

import argparse
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from canprobe.cli.argument_types import node_ids, number_of_32_bits, whole
from canprobe.cli.interrupts import left_by_ctrl_c
from canprobe.cli.parser import Parser
from canprobe.cli.target import loaded, one_channel, real_target, scene_target
from canprobe.errors import UsageError

if TYPE_CHECKING:
    from canprobe.cell.scene.model import Scene

HELP = "serve emulated nodes on a bus"
EXAMPLE = """\
examples:
  canprobe emulate cylinder --channel vcan0
  canprobe emulate cylinder --channel vcan0 --nodes 1-6
  canprobe emulate two.toml --channel can0=vcan0 --channel can1=vcan1
  canprobe emulate cylinder --channel vcan0 --store nodes/
  canprobe emulate --eds drive.eds --node-id 5 --channel vcan0
  canprobe emulate --eds drive.eds --node-id 5 --eds io.eds --node-id 20 --channel vcan0
  canprobe emulate free --channel vcan0 --without-id 3,5
  canprobe emulate --eds drive.eds --node-id 255 --serial 0x4711 --channel vcan0
  canprobe emulate free --channel vcan0 --inject "node 3: heartbeat-off at 5 s"
  canprobe emulate --bus-yml config/bus.yml --channel vcan0
  canprobe emulate --motor damiao:dm4310 --id 1 --channel vcan0
  canprobe emulate --motor damiao:dm8009 --id 1 --mst-id 0x11 --motor damiao:dm4340 --id 3 --mst-id 0x13 --channel vcan0
"""


def add_arguments(parser: Parser) -> None:
    parser.add_shared("[SCENE]", "BUS", "--realtime", "--seed")
    parser.add_eds_nodes(more="; 255: no id, the node waits for LSS")
    parser.add_option(
        "--serial N", "serial number (1018h:04) for the --eds at the same position", number_of_32_bits, many=True
    )
    parser.add_option(
        "--without-id IDS", "nodes that start without an id; `canprobe scan --lss` assigns it", node_ids, default=()
    )
    parser.add_option("--bus-yml FILE", "serve the slaves of a bus.yml of ros2_canopen", Path)
    parser.add_motors()
    parser.add_option("--nodes IDS", "nodes to serve, such as 1-6,16 [those with emulated = true]", node_ids)
    parser.add_option("--truth FILE", "write the true values of the model to this npz file at the end", Path)
    parser.add_option("--store DIR", "folder that keeps what a master stores by 1010h or LSS [nothing is kept]", Path)
    parser.add_inject("throw a fault, as 'node 3: mute at 5 s'")
    parser.add_option("--parent PID", argparse.SUPPRESS, whole(1, 2**31 - 1))  # ends with it
    parser.add_option("--origin NS", argparse.SUPPRESS, whole(0, 2**63 - 1))  # of its times
    parser.add_shared("-v")


def run(args: argparse.Namespace) -> None:
    """Serve until Ctrl-C, which is the normal way to leave."""
    if [args.scene is not None, bool(args.eds or args.motor), args.bus_yml is not None].count(True) != 1:
        raise UsageError("emulate: name a SCENE, or else --eds FILE --node-id N, --bus-yml FILE or --motor TYPE --id N")
    serve = _scene_server(args) if args.scene is not None else _eds_server(args)

    from canprobe.fieldbus.bus.system import system

    with left_by_ctrl_c():
        if args.parent is not None:
            system.end_with_parent(args.parent, signal.SIGTERM)
        serve()


def _scene_server(args: argparse.Namespace) -> Callable[[], None]:
    for option, owner in (("node_id", "eds"), ("serial", "eds"), ("id", "motor"), ("mst_id", "motor")):
        if getattr(args, option):
            name = option.replace("_", "-")
            raise UsageError(f"emulate: --{name} belongs to --{owner}; of a scene's nodes, choose with --nodes")
    scene = loaded(args)
    wanted = _nodes(args.nodes, scene)
    target = scene_target(args, scene)
    if absent := sorted(set(args.without_id) - set(wanted)):
        raise UsageError(f"--without-id: {absent} is not among the nodes to serve, {list(wanted)}")

    from canprobe import api

    return lambda: api.emulate(
        scene,
        target,
        node_ids=wanted,
        seed=args.seed,
        truth_path=args.truth,
        origin_ns=args.origin,
        store_folder=args.store,
        without_id=args.without_id,
        homed=args.parent is not None,  # a run cannot home its emulated nodes
        faults=args.inject,
        say=args.report.say,
        outlasts=args.parent is not None,  # the run decides whether it comes back
    )


def _eds_server(args: argparse.Namespace) -> Callable[[], None]:
    source = "--bus-yml" if args.bus_yml is not None else "--eds" if args.eds else "--motor"
    for option in ("nodes", "seed", "truth", "without_id"):
        if getattr(args, option) not in (None, ()):
            raise UsageError(f"emulate: --{option.replace('_', '-')} belongs to a scene, not to {source}")
    files = eds_files("emulate", args) if args.bus_yml is None else _files_of_bus_yml(args)
    if len(args.serial) > len(files):
        raise UsageError(f"emulate: {len(args.serial)} --serial, but {len(files)} --eds")
    channel = one_channel(args, f"emulate: with {source} there is one channel, without a name: --channel CH")
    target = real_target(args, channel)

    from canprobe.cell.session.served import emulate_eds

    return lambda: emulate_eds(
        files,
        target,
        store_folder=args.store,
        serial_numbers=args.serial,
        motors=(args.motor, args.id, args.mst_id),
        in_realtime=args.realtime,
        faults=args.inject,
        say=args.report.say,
    )


def _files_of_bus_yml(args: argparse.Namespace) -> list[tuple[str | Path, int]]:
    from canprobe.lab.bridge.bus_yml import read_bus_yml

    if args.node_id or args.serial:
        raise UsageError("emulate: --node-id and --serial belong to --eds; a bus.yml has its own")
    return [(node.eds, node.node_id) for node in read_bus_yml(args.bus_yml, args.report.say)]


def eds_files(command: str, args: argparse.Namespace) -> list[tuple[str | Path, int]]:
    """File and node id of each node without a scene."""
    if len(args.eds) != len(args.node_id):
        raise UsageError(
            f"{command}: {len(args.eds)} --eds, but {len(args.node_id)} --node-id; each file needs its own"
        )
    return list(zip(args.eds, args.node_id, strict=True))


def _nodes(wanted: tuple[int, ...] | None, scene: Scene) -> tuple[int, ...]:
    known = {*scene.drives, *(one.node_id for one in (scene.sensor, scene.carrier) if one is not None)}
    if wanted is None:
        wanted = scene.emulated_node_ids
    if missing := sorted(set(wanted) - known):
        raise UsageError(f"--nodes: scene {scene.name} has no node {missing}; it has {sorted(known)}")
    if not wanted and (scene.sensor is None or scene.array_is_node or not scene.sensor.emulated):
        raise UsageError(f"scene {scene.name} marks no node as emulated; name some with --nodes")
    return wanted
