"""Emulated nodes on a real interface: the nodes of a scene, or one node from each EDS file."""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Protocol

from canprobe.cell.master.options import Say, quiet
from canprobe.cell.npz import write_npz
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.warnings import bus_open_to_others
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.links import ExpectedLink, check_links, data_bitrate
from canprobe.cell.session.session import rehearse
from canprobe.cell.session.target import Target
from canprobe.errors import NodeError, ResultsError, UsageError
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.files import make_folder
from canprobe.fieldbus.bus.port import Port, Reports
from canprobe.fieldbus.bus.presence import answering_nodes
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.real.memory import garbage_collection_paused, reserve_memory
from canprobe.fieldbus.bus.real.processor import DEVICE_PRIORITY, ask_for_processor, realtime
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.eds.packaged import check_eds
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.lss import UNCONFIGURED_ID
from canprobe.fieldbus.tools.faults import FaultyNode, FaultyNodes

ALL_CYCLES_PERCENT = 100
"""`limits.late_cycles_max_percent` with which late cycles stop nothing."""


class ServeObserver(Protocol):
    """Observer of served nodes. `look` returns True to stop serving."""

    def tap(self, port: Port) -> Port:
        """A port in the place of the port of the nodes."""

    def begin(self, nodes: FaultyNodes, now_ns: int) -> None:
        """The nodes are about to be served."""

    def look(self, now_ns: int) -> bool:
        """Look after each wait; whether serving ends."""


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
    _make_places(truth_path, store_folder)
    with contextlib.ExitStack() as stack:
        ports: dict[str, Port] = {}
        for channel in dict.fromkeys((*placed.values(), *([raw_at] if raw_at is not None else []))):
            busy = tuple(i for i, place in placed.items() if place == channel and i not in without_id)
            one = replace(target, channel=channel)
            ports[channel] = stack.enter_context(_free_port(one, wanted, busy, way_out=way_out, say=say))
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
        _keep(world.nodes, store_folder)
        try:
            _serve(
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


def emulate_eds(
    files: Sequence[tuple[str | Path, int]],
    target: Target,
    *,
    store_folder: Path | None = None,
    serial_numbers: Sequence[int | None] = (),
    positions: Sequence[int] = (),
    in_realtime: bool = False,
    faults: Sequence[str] = (),
    observer: ServeObserver | None = None,
    say: Say = quiet,
) -> None:
    """Serve a node from each EDS file on a real interface until interrupted, for any master.

    Args:
        files: (name or path of an EDS, DCF, XDD or XDC file, node id) of each node; 255: it waits for LSS.
        target: the bus.
        store_folder: as for :func:`emulate`.
        serial_numbers: 1018h:04 of each node; None or left out: as its file has it.
        positions: place of the motor of each drive at first, counts; left out: 0.
        in_realtime: whether to ask for SCHED_FIFO, a processor and locked memory.
        faults, observer: as for :func:`emulate`.
        say: called with the number of warnings of each file, and when the nodes are served.

    Raises:
        EdsError: when a file cannot be served; one line for each fault.
        UsageError: when a fault is wrong, a node id is given twice, two nodes without one are the same device, or a
            file of `store_folder` belongs to another node.
        InterfaceError: when there is no such interface.
        NodeError: when a node on the bus has one of the ids already.
        ResultsError: when `store_folder` cannot be written.
    """
    from canprobe.fieldbus.drive.from_eds import make_eds_node

    node_ids = tuple(node_id for _, node_id in files if node_id != UNCONFIGURED_ID)
    if twice := sorted({node_id for node_id in node_ids if node_ids.count(node_id) > 1}):
        raise UsageError(f"node id {twice[0]} is given to more than one EDS file")
    nodes: list[SlaveNode] = []
    for (name, node_id), serial, position in zip_longest(files, serial_numbers, positions):
        reading = check_eds(name, 1 if node_id == UNCONFIGURED_ID else node_id)
        od = reading.usable()
        speaks_lss = node_id == UNCONFIGURED_ID or od.device_information.LSS_supported
        nodes.append(
            make_eds_node(od, node_id, eds=name if speaks_lss else None, serial=serial, position=position or 0)
        )
        if warnings := len(reading.warnings):
            check = f"canprobe eds check {name} --node-id {od.node_id}"
            say(f"{name}: {warnings} warning{'s' * (warnings > 1)}; `{check}` lists them")
    _check_addresses(nodes)
    _make_places(None, store_folder)
    wanted, way_out = ExpectedLink(target.bitrate, of_scene=False), "end that node, or give another --node-id"
    with _free_port(target, wanted, node_ids, way_out=way_out, say=say) as port:
        for node in nodes:
            if node.lss is not None:
                node.lss.bitrate = target.bitrate
        _keep(nodes, store_folder)
        faulty = FaultyNodes(map(FaultyNode, nodes))
        _serve([(faulty.nodes, port)], faulty, faults, observer, say=say, in_realtime=in_realtime)


def _make_places(truth_path: Path | None, store_folder: Path | None) -> None:
    """Make the folders of the files, so that a place that cannot be written fails at the beginning."""
    if store_folder is not None:
        make_folder(store_folder)
    if truth_path is not None:
        make_folder(truth_path.parent)
        if truth_path.is_dir():
            raise ResultsError(f"{truth_path}: cannot be written: {os.strerror(errno.EISDIR)}")


@contextlib.contextmanager
def _free_port(
    target: Target, wanted: ExpectedLink, node_ids: tuple[int, ...], *, way_out: str, say: Say
) -> Iterator[Port]:
    """A port on a bus on which no node has these ids; it waits for the bus as a device does."""
    from canprobe.fieldbus.bus.real.opening import open_port

    check_links(target.interface, {target.channel: wanted}, say)
    for warning in bus_open_to_others(target.interface, target.channel):
        say(f"warning: {warning}")
    port = open_port(
        target.interface,
        target.channel,
        target.bitrate,
        MonotonicClock(),
        data_bitrate=wanted.data_bitrate,
        waits=True,
        reports=Reports(say=say),
    )
    try:
        if busy := answering_nodes(PumpedNetwork(port), node_ids, 0.1):
            raise NodeError(busy[0], f"is on {target.channel} already; its id is busy: {way_out}")
        yield port
    finally:
        port.close()


def _check_addresses(nodes: Sequence[SlaveNode]) -> None:
    """Check that nodes without an id have different LSS addresses."""
    addresses = [node.lss.address for node in nodes if node.lss is not None and node.lss.unconfigured]
    for address in addresses:
        if addresses.count(address) > 1:
            raise UsageError(f"two nodes without an id are the device {address}: give each its --serial")


def _serve(
    buses: Sequence[tuple[Sequence[Participant], Port]],
    faulty: FaultyNodes,
    faults: Sequence[str],
    observer: ServeObserver | None,
    *,
    say: Say,
    in_realtime: bool,
    cycles_kept: int = 0,
    outlasts: bool = False,
) -> None:
    """Serve nodes until interrupted, and throw the faults that are given and those that come by the control channel."""
    from canprobe.fieldbus.node.serve import serve
    from canprobe.fieldbus.tools.faults.control import ControlServer

    reserve_memory(cycles_kept)
    for _, port in buses:
        port.drain()  # frames that passed meanwhile
    ask_for_processor()
    favour = realtime(DEVICE_PRIORITY, say, processor_from_last=1) if in_realtime else contextlib.nullcontext()
    where = " and ".join(port.channel for _, port in buses)
    clock = buses[0][1].clock
    with contextlib.ExitStack() as stack:
        stack.enter_context(favour)
        servers = []
        try:
            servers = [stack.enter_context(ControlServer(port.channel, faulty)) for _, port in buses]
        except (OSError, UsageError) as error:
            say(f"warning: `canprobe inject` cannot reach these nodes: {error}")
        start_ns = clock.now_ns()
        for text in faults:
            say(f"fault: {faulty.inject(text, start_ns).words(start_ns)}")
        say(f"serving {_named([node.node for node in faulty.nodes]) or 'the array'} on {where}; Ctrl-C stops them")

        def look() -> bool:
            for server in servers:
                server.poll(clock.now_ns())
            return observer is not None and observer.look(clock.now_ns())

        if observer is not None:
            buses = [(nodes, observer.tap(port)) for nodes, port in buses]
            observer.begin(faulty, start_ns)
        with garbage_collection_paused():
            serve(buses, look, outlasts=outlasts)


def _named(nodes: Sequence[SlaveNode]) -> str:
    """Names of nodes: their ids, or their LSS addresses where they have none."""
    ids = sorted(node.node_id for node in nodes if node.node_id != UNCONFIGURED_ID)
    blank = [str(node.lss.address) for node in nodes if node.lss is not None and node.lss.unconfigured]
    with_ids = [f"nodes {', '.join(map(str, ids))}"] if ids else []
    return ", and ".join(with_ids + ([f"without an id {', '.join(blank)}"] if blank else []))


def _keep(nodes: Iterable[SlaveNode], folder: Path | None) -> None:
    """Let each node keep what a master stores by 1010h in its file."""
    from canprobe.fieldbus.node.stored_file import keep_in_file

    if folder is not None:
        for node in nodes:
            unnamed = node.node_id == UNCONFIGURED_ID  # it has no id yet, and its serial number names its file
            name = f"serial{node.dictionary.number(0x1018, 4):08x}" if unnamed else f"node{node.node_id:03}"
            keep_in_file(node, folder / f"{name}.json")
