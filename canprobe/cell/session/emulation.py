"""Emulated nodes of a scene on a real interface, for any master."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from canprobe.cell.master.options import Say, quiet
from canprobe.cell.npz import write_npz
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.links import ExpectedLink, data_bitrate
from canprobe.cell.session.served import ServeObserver, free_port, keep_in, make_places, serve_nodes
from canprobe.cell.session.session import rehearse
from canprobe.cell.session.target import Target
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.virtual.lockstep import Participant

ALL_CYCLES_PERCENT = 100
"""`limits.late_cycles_max_percent` with which late cycles stop nothing."""


def emulate(
    scene: Scene,
    target: Target,
    *,
    node_ids: tuple[int, ...],
    seed: int | None = None,
    truth_path: Path | None = None,
    origin_ns: int | None = None,
    store_folder: Path | None = None,
    without_id: tuple[int, ...] = (),
    homed: bool = False,
    faults: Sequence[str] = (),
    observer: ServeObserver | None = None,
    say: Say = quiet,
    outlasts: bool = False,
) -> None:
    """Serve emulated nodes on a real interface until interrupted, for any master.

    Args:
        scene: the scene of the nodes.
        target: the bus, and names for the scene's other channels; a channel that it does not name is the bus.
        node_ids: ids of the nodes to serve.
        seed: replaces the seed of the scene.
        truth_path: file for the plant's true values, written at the end.
        origin_ns: time on CLOCK_MONOTONIC that is 0 in that file; by default the time when the nodes begin.
        store_folder: folder with a file for each node, where 1010h and LSS store; None: it forgets at the end.
        without_id: ids of the nodes that start without a node id and wait for LSS.
        homed: whether drives that need homing start with their zeros, and keep them.
        faults: faults, as `canprobe.fieldbus.tools.faults.parse_fault` reads them; their times count from the start.
        observer: observer of the nodes, which may end the serving.
        say: called when the nodes are about to be served.
        outlasts: whether the nodes outlast an interface that is down for a while.

    Raises:
        UsageError: when the scene does not fit, a fault is wrong, or a file of `store_folder` belongs to another node.
        InterfaceError: when there is no such interface.
        NodeError: when a node on the bus has one of the ids already.
        ResultsError: when `truth_path` or `store_folder` cannot be written; raised before the nodes start.
    """
    from canprobe.cell.emulated.world import make_world

    scene = load_scene(scene, {} if seed is None else {"scene.seed": seed})
    of_scene = replace(target, channel=scene.bus.channel, others={})  # the scene says which node is on which bus
    plan = make_plan(resolve(of_scene.applied_to(scene)))
    names = {scene.bus.channel: target.channel, **target.others}
    placed = {n.node_id: names.get(n.channel, target.channel) for n in plan.nodes if n.node_id in node_ids}
    array = plan.setup.array
    raw_at = names.get(array.channel, target.channel) if array is not None and array.raw and array.emulated else None
    wanted = ExpectedLink(target.bitrate, data_bitrate(plan.setup.bus))
    way_out = _where_served(scene) if outlasts else "end that node, or name others with --nodes"
    make_places(truth_path, store_folder)
    with contextlib.ExitStack() as stack:
        ports: dict[str, Port] = {}
        for channel in dict.fromkeys((*placed.values(), *([raw_at] if raw_at is not None else []))):
            busy = tuple(i for i, place in placed.items() if place == channel and i not in without_id)
            one = replace(target, channel=channel)
            ports[channel] = stack.enter_context(free_port(one, wanted, busy, way_out=way_out, say=say))
        rehearse(plan)
        world = make_world(plan, node_ids, truth=truth_path is not None, without_id=without_id, homed=homed)
        on: dict[str, list[Participant]] = {channel: [] for channel in ports}
        faulty = world.make_faulty()
        for node, channel in zip(faulty.nodes, placed.values(), strict=True):
            on[channel].append(node)
        if world.raw_array is not None and raw_at is not None:
            on[raw_at].append(world.raw_array)
        if world.recorder is not None:
            world.recorder.origin_ns = MonotonicClock().now_ns() if origin_ns is None else origin_ns
            next(iter(on.values())).append(world.recorder)
        keep_in(world.nodes, store_folder)
        try:
            serve_nodes(
                [(on[channel], port) for channel, port in ports.items()],
                faulty,
                faults,
                observer,
                say=say,
                in_realtime=plan.setup.realtime,
                cycles_kept=plan.cycles if truth_path is not None else 0,
                outlasts=outlasts,
            )
        finally:
            if truth_path is not None and world.recorder is not None:
                write_npz(truth_path, world.recorder.columns())


def _where_served(scene: Scene) -> str:
    """What to type where another process serves the nodes that a run was about to serve itself."""
    keys = [f"{part}.emulated=false" for part in ("arm", "sensor") if getattr(scene, part) is not None]
    patient = scene.limits.late_cycles_max_percent == ALL_CYCLES_PERCENT
    if patient and scene.arm is not None:  # the values of --patient, which real nodes refuse
        keys += [f"arm.missed_syncs={scene.arm.missed_syncs}", f"limits.late_cycles_max_percent={ALL_CYCLES_PERCENT}"]
    options = " ".join(f"--set {key}" for key in keys)
    return (
        "end that node, or, where `canprobe emulate` serves the nodes of this scene, take them as real ones:"
        f" {'leave out --patient and add ' * patient}{options}"
    )
