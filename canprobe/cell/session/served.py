"""Nodes served on a real interface until interrupted: one from each EDS file; and what those of a scene share.

None of a cell is imported: `canprobe judge` and `canprobe emulate` work for an EDS file without numpy.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterable, Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from canprobe.cell.session.links import ExpectedLink, check_links
from canprobe.errors import NodeError, ResultsError, UsageError
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.files import make_folder
from canprobe.fieldbus.bus.port import Port, Reports, nothing
from canprobe.fieldbus.bus.presence import answering_nodes
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.real.adapters import bus_open_to_others
from canprobe.fieldbus.bus.real.memory import garbage_collection_paused, reserve_memory
from canprobe.fieldbus.bus.real.processor import DEVICE_PRIORITY, ask_for_processor, realtime
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.eds.packaged import check_eds
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.lss import UNCONFIGURED_ID
from canprobe.fieldbus.tools.faults import FaultyNode, FaultyNodes

if TYPE_CHECKING:
    from canprobe.cell.master.options import Say
    from canprobe.cell.session.target import Target


class ServeObserver(Protocol):
    """Observer of served nodes. `look` returns True to stop serving."""

    def tap(self, port: Port) -> Port:
        """A port in the place of the port of the nodes."""

    def begin(self, nodes: FaultyNodes, now_ns: int) -> None:
        """The nodes are about to be served."""

    def look(self, now_ns: int) -> bool:
        """Look after each wait; whether serving ends."""


def emulate_eds(
    files: Sequence[tuple[str | Path, int]],
    target: Target,
    *,
    store_folder: Path | None = None,
    serial_numbers: Sequence[int | None] = (),
    positions: Sequence[int] = (),
    motors: tuple[Sequence[str], Sequence[int], Sequence[int]] = ((), (), ()),
    in_realtime: bool = False,
    faults: Sequence[str] = (),
    observer: ServeObserver | None = None,
    say: Say = nothing,
) -> None:
    """Serve a node from each EDS file on a real interface until interrupted, for any master.

    Args:
        files: (name or path of an EDS, DCF, XDD or XDC file, node id) of each node; 255: it waits for LSS.
        target: the bus.
        store_folder: as for :func:`canprobe.cell.session.bus_tools.emulate`.
        serial_numbers: 1018h:04 of each node; None or left out: as its file has it.
        positions: place of the motor of each drive at first, counts; left out: 0.
        motors: make and type, ESC_ID and MST_ID of motors beside them, as `motors_on_bus` takes them.
        in_realtime: whether to ask for SCHED_FIFO, a processor and locked memory.
        faults, observer: as for :func:`canprobe.cell.session.bus_tools.emulate`.
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
    from canprobe.fieldbus.motor.on_bus import motors_on_bus
    from canprobe.fieldbus.tools.faults.motor_faults import FaultyMotor

    node_ids = tuple(node_id for _, node_id in files if node_id != UNCONFIGURED_ID)
    if twice := sorted({node_id for node_id in node_ids if node_ids.count(node_id) > 1}):
        raise UsageError(f"node id {twice[0]} is given to more than one EDS file")
    beside = motors_on_bus(*motors, node_ids)
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
    make_places(None, store_folder)
    wanted, way_out = ExpectedLink(target.bitrate, of_scene=False), "end that node, or give another --node-id"
    with free_port(target, wanted, node_ids, way_out=way_out, say=say) as port:
        for node in nodes:
            if node.lss is not None:
                node.lss.bitrate = target.bitrate
        keep_in(nodes, store_folder)
        faulty = FaultyNodes([*map(FaultyNode, nodes), *map(FaultyMotor, beside)])
        serve_nodes([(faulty.nodes, port)], faulty, faults, observer, say=say, in_realtime=in_realtime)


def make_places(truth_path: Path | None, store_folder: Path | None) -> None:
    """Make the folders of the files, so that a place that cannot be written fails at the beginning."""
    if store_folder is not None:
        make_folder(store_folder)
    if truth_path is not None:
        make_folder(truth_path.parent)
        if truth_path.is_dir():
            raise ResultsError(f"{truth_path}: cannot be written: {os.strerror(errno.EISDIR)}")


@contextlib.contextmanager
def free_port(
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


def serve_nodes(
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
        say(f"serving {_named(faulty) or 'the array'} on {where}; Ctrl-C stops them")

        def look() -> bool:
            for server in servers:
                server.poll(clock.now_ns())
            return observer is not None and observer.look(clock.now_ns())

        if observer is not None:
            buses = [(nodes, observer.tap(port)) for nodes, port in buses]
            observer.begin(faulty, start_ns)
        with garbage_collection_paused():
            serve(buses, look, outlasts=outlasts)


def _named(faulty: FaultyNodes) -> str:
    """Names of nodes: their ids, or their LSS addresses where they have none; and of motors."""
    motors = [str(node.node_id) for node in faulty.nodes if not isinstance(node.node, SlaveNode)]
    nodes = [node.node for node in faulty.nodes if isinstance(node.node, SlaveNode)]
    ids = sorted(node.node_id for node in nodes if node.node_id != UNCONFIGURED_ID)
    blank = [str(node.lss.address) for node in nodes if node.lss is not None and node.lss.unconfigured]
    with_ids = [f"nodes {', '.join(map(str, ids))}"] if ids else []
    without_ids = [f"without an id {', '.join(blank)}"] if blank else []
    return ", and ".join(with_ids + without_ids + ([f"motors {', '.join(motors)}"] if motors else []))


def keep_in(nodes: Iterable[SlaveNode], folder: Path | None) -> None:
    """Let each node keep what a master stores by 1010h in its file."""
    from canprobe.fieldbus.node.stored_file import keep_in_file

    if folder is not None:
        for node in nodes:
            unnamed = node.node_id == UNCONFIGURED_ID  # it has no id yet, and its serial number names its file
            name = f"serial{node.dictionary.number(0x1018, 4):08x}" if unnamed else f"node{node.node_id:03}"
            keep_in_file(node, folder / f"{name}.json")
