"""A bus without a cell: list its nodes, give ids to nodes without one, watch a running cell, serve emulated nodes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from canprobe.cell.master.commission import Commissioned, Wanted, scan_nodes, wanted_by
from canprobe.cell.master.commission import commission as commission_nodes
from canprobe.cell.master.monitor import CellView, Monitor
from canprobe.cell.master.options import Say, quiet
from canprobe.cell.npz import write_npz
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.hardware import BringUpSettings
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.buses import open_ports
from canprobe.cell.session.links import ExpectedLink, check_links, data_bitrate, expected_of, need_controllers
from canprobe.cell.session.served import ServeObserver, free_port, keep_in, make_places, serve_nodes
from canprobe.cell.session.session import rehearse
from canprobe.cell.session.target import Target, open_bus, refuse_virtual
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.motor.search import find_motors

MONITOR_PERIOD_NS = 100_000_000
SILENCE_NS = 1_000_000_000
"""Time without a frame on a bus after which the state of its controller is read."""


def scan(
    target: Target | Port, *, timeout_s: float | None = None, motors: bool = False, say: Say = quiet
) -> list[dict[str, Any]]:
    """List the nodes that answer or send heartbeats on a bus, with the identity that 1018h gives; or its motors.

    Args:
        target: the bus, or a port of it, which stays open.
        timeout_s: longest time to one SDO answer; by default that of a bring-up.
        motors: whether to list motors that speak no CANopen instead: see `canprobe.fieldbus.motor.search.find_motors`.
        say: called with each warning about the interface's setting.

    Raises:
        UsageError: when motors are asked for where CANopen nodes are heard.
        InterfaceError: when there is no such interface, or the CAN controller's state explains that no node answers.
    """
    with open_bus(target, say) if isinstance(target, Target) else contextlib.nullcontext(target) as port:
        found = find_motors if motors else scan_nodes
        nodes = found(port, timeout_s or BringUpSettings().sdo_s)
    if not nodes and isinstance(target, Target):
        need_controllers(target.interface, {target.channel: port})
    return nodes


def commission(
    target: Target,
    *,
    scene: Scene | None = None,
    assign: Sequence[tuple[tuple[int | None, int | None, int | None, int | None], int]] = (),
    store: bool = True,
    timeout_s: float | None = None,
    say: Say = quiet,
) -> Commissioned:
    """Find the nodes that have no id and give them theirs by LSS (CiA 305).

    Args:
        target: the bus.
        scene: scene whose nodes get their ids, as far as EDS files and serial numbers identify the devices.
        assign: without a scene: ((vendor, product, revision, serial number), node id), None for any number.
        store: whether the devices store their ids.
        timeout_s: longest time to one SDO answer; by default that of the scene, or else of a bring-up.
        say: called with each warning about the interface's setting.

    Raises:
        UsageError: when the scene does not fit.
        BusError: see `canprobe.cell.master.commission.commission`.
        InterfaceError: when there is no such interface, or the CAN controller's state explains that no node answers.
    """
    wanted = [Wanted(node_id, "--assign", numbers) for numbers, node_id in assign]
    if scene is not None:
        on_interface = replace(Target.over(scene), interface=target.interface)
        wanted = wanted_by(make_plan(resolve(on_interface.applied_to(scene))))
    answer_s = timeout_s or (BringUpSettings() if scene is None else scene.bring_up).sdo_s
    with open_bus(target, say) as port:
        done = commission_nodes(port, wanted, must=scene is None, store=store, timeout_s=answer_s)
    if not done.nodes and not done.unconfigured:
        need_controllers(target.interface, {target.channel: port})
    return done


def monitor(scene: Scene, *, duration_s: float | None = None, say: Say = quiet) -> Iterator[CellView]:
    """Watch a running cell ten times a second without sending anything.

    Args:
        scene: scene of the cell.
        duration_s: length of the watch; without end by default.
        say: called with each warning about the interface's setting.

    Yields:
        The view of the cell so far; the same object each time.

    Raises:
        UsageError: when the scene does not fit, or its bus is a lockstep bus, which lives inside one run.
        InterfaceError: when there is no such interface, it was lost, or its controller's state explains its silence.
    """
    refuse_virtual(scene.bus.interface, "monitor")
    plan, clock, interface = make_plan(resolve(scene)), MonotonicClock(), scene.bus.interface
    wanted = {name: replace(expected, frames_at_once=0) for name, expected in expected_of(plan).items()}
    check_links(interface, wanted, say, must=False)
    with open_ports(plan, clock) as ports:
        listener = Monitor(plan)
        start_ns = next_ns = clock.now_ns()
        duration_ns = None if duration_s is None else duration_s * 1e9
        patience_ns = SILENCE_NS if duration_ns is None else min(SILENCE_NS, duration_ns)
        heard_ns = dict.fromkeys(ports, start_ns)
        while duration_ns is None or next_ns < start_ns + duration_ns:
            next_ns += MONITOR_PERIOD_NS
            clock.sleep_until_ns(next_ns)
            for name, port in ports.items():
                if frames := port.drain():
                    listener.push(frames, name)
                    heard_ns[name] = next_ns
                elif next_ns - heard_ns[name] >= patience_ns:
                    need_controllers(interface, {name: port})
                    heard_ns[name] = next_ns  # the state is asked for once a second at most
            yield listener.view(clock.now_ns())


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
    keys = [f"{part}.emulated=false" for part in ("arm", "sensor", "carrier") if getattr(scene, part) is not None]
    patient = scene.limits.late_cycles_max_percent == ALL_CYCLES_PERCENT
    if patient and scene.arm is not None:  # the values of --patient, which real nodes refuse
        keys += [f"arm.missed_syncs={scene.arm.missed_syncs}", f"limits.late_cycles_max_percent={ALL_CYCLES_PERCENT}"]
    options = " ".join(f"--set {key}" for key in keys)
    return (
        "end that node, or, where `canprobe emulate` serves the nodes of this scene, take them as real ones:"
        f" {'leave out --patient and add ' * patient}{options}"
    )
