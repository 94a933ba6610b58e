"""The buses of a session with what is on their other side: emulated nodes in virtual time, or real interfaces.

Their traffic is counted, written into ``bus.log`` and shown to the observers.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canprobe.cell.master.cycle import Cycle
from canprobe.cell.master.observers import Observers
from canprobe.cell.master.options import RunOptions, quiet
from canprobe.cell.planning.measured import TrafficMeter
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.wire_time import exact_frame_bits, unstuffed_frame_bits
from canprobe.cell.scene.hardware import BusSettings
from canprobe.cell.scene.model import Scene
from canprobe.cell.session.child_process import EmulatorChild
from canprobe.cell.session.folder import BUS_LOG, KeptFiles, prepare_folder
from canprobe.cell.session.links import check_links, data_bitrate, expected_of
from canprobe.cell.session.target import DIRECT, LOCKSTEP
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.candump import CandumpWriter, RecordingPort
from canprobe.fieldbus.bus.clock import Clock, MonotonicClock, VirtualClock
from canprobe.fieldbus.bus.files import make_folder
from canprobe.fieldbus.bus.joined import JoinedPort
from canprobe.fieldbus.bus.port import Port, Reports, is_bus_error
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus
from canprobe.fieldbus.protocol.frame_bits import exact_bits
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, SDO_RX_BASE, SDO_TX_BASE
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.cell.emulated.world import World


Write = Callable[[int, bytes, int], None]


class TrafficCounter:
    """Counts frames and bits of a bus in real time; bits without stuffing, as `canbusload -i` counts.

    Args:
        bus: bit rates of the bus.

    Attributes:
        error_frames: number of bus errors; whoever receives one counts it here.
    """

    def __init__(self, bus: BusSettings) -> None:
        self._by_length = [0] * 65
        self._bus = bus
        self.error_frames = 0

    @property
    def frames(self) -> int:
        """Number of frames so far."""
        return sum(self._by_length)

    @property
    def bits(self) -> int:
        """Number of bits so far, those of a data phase in bits of the nominal rate."""
        counted = enumerate(self._by_length)
        return sum(count * unstuffed_frame_bits(n, self._bus) for n, count in counted if count)

    def write(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Count one frame."""
        self._by_length[len(data)] += 1


class BusRecord:
    """Record of every bus of a run.

    Args:
        plan: plan of the run.
        out: folder for ``bus.log``, which the first `writer` prepares, where the scene wants it; None writes nothing.
        observers: observers that get the frames; None where there are none.
        stack: the way out of the session, which closes ``bus.log``.

    Attributes:
        origin_ns: time on the clock of the buses from which the log counts.
        traffic: counter of each channel.
        meters: meters of a lockstep bus, which compare the traffic with the plan during the run; on a real bus
            the log is compared afterwards.
    """

    def __init__(self, plan: Plan, out: Path | None, observers: Observers | None, stack: ExitStack) -> None:
        self.origin_ns = 0
        self.traffic: dict[str, TrafficCounter | TrafficMeter] = {}
        self.meters: dict[str, TrafficMeter] = {}
        self._plan = plan
        self._out = out
        self._observers = observers
        self._candump: CandumpWriter | None = None
        self._writers: dict[str, Write] = {}
        self._time_ns = 0
        self._stack = stack

    def writer(self, channel: str) -> Write:
        """Make the function that takes each frame of a bus; a bus that is opened again has the same one."""
        if channel not in self._writers:
            self._writers[channel] = self._make_writer(channel)
        return self._writers[channel]

    def _make_writer(self, channel: str) -> Write:
        bus = self._plan.scene.bus
        if bus.interface == LOCKSTEP:
            self.traffic[channel] = self.meters[channel] = TrafficMeter(self._plan, channel, exact=False)
        else:
            self.traffic[channel] = TrafficCounter(bus)
        write: Write = self.traffic[channel].write
        if self._out is not None and not self._writers:
            if BUS_LOG in self._plan.outputs:
                make_folder(self._out)
                log = CandumpWriter(self._out / BUS_LOG, channel, self.origin_ns)
                self._candump = self._stack.enter_context(log)
            prepare_folder(self._plan, self._out)
        if self._candump is not None:
            write = self._candump.on(channel, write)
        if self._observers is not None:
            self._observers.origin_ns = self.origin_ns
            write = self._observers.tap(write)
        return write

    def error_writer(self, channel: str) -> Write:
        """Make the function that counts each error frame of a bus and writes it into the log."""

        def note(can_id: int, data: bytes, t_ns: int) -> None:
            self.traffic[channel].error_frames += is_bus_error(can_id)
            if self._candump is not None:
                self._candump.on(channel)(can_id, data, t_ns)

        return note

    def failure(self) -> str | None:
        """Why frames are no longer written into the log; None while they are."""
        return self._candump.failure if self._candump is not None else None

    @contextmanager
    def timed(self, clock: Clock) -> Iterator[None]:
        """Measure the time over which the loads are taken."""
        start_ns = clock.now_ns()
        try:
            yield
        finally:
            self._time_ns = clock.now_ns() - start_ns

    def load(self, channel: str) -> float | None:
        """Measured load, a share of the bit rate; None where nothing was measured."""
        if channel not in self.traffic or self._time_ns <= 0:
            return None
        return self.traffic[channel].bits / (self._plan.scene.bus.bitrate * self._time_ns * 1e-9)


class SessionBuses(ABC):
    """The buses of a session.

    Args:
        plan: plan of the cell.
        options: options of the run.
        files: files of the run's folder.
        stack: the way out of the session.

    Attributes:
        ports: ports of the interfaces, by channel; empty in virtual time.
        lockstep: the first bus in virtual time, once it is open.
        make_cycle: makes a cycle without a bus; None where there is one.
        truth: the plant's true values, at the end; empty where nothing was emulated.
    """

    def __init__(self, plan: Plan, options: RunOptions, files: KeptFiles, stack: ExitStack) -> None:
        self.ports: dict[str, Port] = {}
        self.lockstep: LockstepBus | None = None
        self.make_cycle: Callable[..., Cycle] | None = None
        self.truth: Mapping[str, Floats] = {}
        self._child: EmulatorChild | None = None
        self._plan, self._options, self._files, self._stack = plan, options, files, stack

    @cached_property
    def world(self) -> World:
        """The emulated nodes and their plant in this process; participants may be replaced until the buses open."""
        from canprobe.cell.emulated.world import make_world

        nodes, folder = self._plan.scene.emulated_node_ids, self._options.rows_folder
        return make_world(self._plan, nodes, truth=self._wants_truth, at_once=True, folder=folder)

    @property
    def _wants_truth(self) -> bool:
        """Whether the truth is recorded, which grows with time."""
        return self._options.rows_kept is None and self._plan.setup.outputs.truth

    @abstractmethod
    def open(self, record: BusRecord) -> Port:
        """Open the buses, each recorded; one port for the cell, whatever their number.

        Raises:
            UsageError: the scene does not fit these buses.
            InterfaceError: an interface is missing, down, set wrong or cannot be opened.
        """

    def reopen(self, port: Port) -> Port:
        """Open the interfaces again; in virtual time there is nothing to open.

        Raises:
            InterfaceError: one is missing, down or bus-off.
        """
        return port

    def raise_ended(self) -> None:
        """Raise the error with which the process of the emulated nodes ended; nothing where it runs, or there is none.

        Raises:
            BusError: it ended.
        """
        if self._child is not None:
            self._child.raise_ended()

    def _need_emulated(self, what: str) -> None:
        if missing := set(self._plan.node_ids) - set(self._plan.scene.emulated_node_ids):
            raise UsageError(f"{what} emulated nodes only: node {min(missing)} is marked emulated = false")

    def _keep_truth(self) -> None:
        if self.world.recorder is not None:
            self.truth = self._files.keep("truth.npz", self.world.recorder)

    def _joined(self, ports: dict[str, Port]) -> Port:
        if len(ports) == 1:
            return ports.popitem()[1]
        routes = {frames.can_id: frames.channel for frames in self._plan.raw}
        routes |= {pdo.cob_id: pdo.channel for pdo in self._plan.pdos}
        for node in self._plan.nodes:  # identifiers that only one node sends or reads
            for base in (SDO_RX_BASE, SDO_TX_BASE, EMCY_BASE, HEARTBEAT_BASE):
                routes[base + node.node_id] = node.channel
        return JoinedPort(ports, routes)


class NoBus(SessionBuses):
    """Counts and images in the place of frames: the port's bus has no node, only its clock is used."""

    def open(self, record: BusRecord) -> Port:
        from canprobe.cell.session.direct import DirectCycle

        self._need_emulated("without a bus there are")
        if (out := self._options.out) is not None:
            prepare_folder(self._plan, out)
        self._stack.callback(self._keep_truth)
        self.make_cycle = partial(DirectCycle, world=self.world)
        clock = VirtualClock()
        nobody = LockstepBus(clock, self._plan.buses[0].channel)
        clock.detach(nobody)
        return nobody.port()


class VirtualBuses(SessionBuses):
    """Buses in virtual time, with the emulated nodes in this process."""

    def open(self, record: BusRecord) -> Port:
        plan, array = self._plan, self._plan.setup.array
        self._need_emulated("a lockstep bus has")
        if array is not None and not array.emulated:
            raise UsageError("a lockstep bus has emulated devices only: sensor.emulated = false")
        clock = VirtualClock()
        buses = {bus.channel: lockstep_bus(plan.scene, clock, bus.channel) for bus in plan.buses}
        for channel, bus in buses.items():
            bus.recorder = record.writer(channel)
            bus.error_recorder = record.error_writer(channel)
        self.lockstep = buses[plan.buses[0].channel]
        participants = self.world.participants
        self._stack.callback(self._keep_truth)
        bus_of = {node.node_id: buses[node.channel] for node in plan.nodes}
        for participant in participants:
            bus = bus_of.get(getattr(participant, "node_id", 0), self.lockstep)
            if participant is self.world.raw_array and array is not None:
                bus = buses[array.channel]
            bus.attach(participant)
        return self._joined({channel: bus.port() for channel, bus in buses.items()})


class RealBuses(SessionBuses):
    """Real interfaces, with the emulated nodes in a process of their own."""

    def __init__(self, plan: Plan, options: RunOptions, files: KeptFiles, stack: ExitStack) -> None:
        super().__init__(plan, options, files, stack)
        self._open_ports = stack.enter_context(ExitStack())  # left last, also those that were opened again
        self._record: BusRecord  # once opened

    def open(self, record: BusRecord) -> Port:
        bus = self._plan.scene.bus
        if bus.interface == "virtual" and self._plan.setup.emulates:
            raise UsageError(
                "python-can's virtual bus ends at the process, and emulated nodes have one of their own; use --bus"
                " lockstep, or --bus socketcan --channel vcan0 by: canprobe vcan -- COMMAND"
            )
        check_links(bus.interface, expected_of(self._plan), self._options.say)
        clock = MonotonicClock()
        self._record, record.origin_ns = record, clock.now_ns()
        return self._open(record, clock)

    def reopen(self, port: Port) -> Port:
        check_links(self._plan.scene.bus.interface, expected_of(self._plan), quiet)
        return self._open(self._record, port.clock)

    def _open(self, record: BusRecord, clock: Clock) -> Port:
        """Open the ports of all buses, in the place of those that were open; their counters go on."""
        before = self.ports
        for port in before.values():
            port.close()
        ports = open_ports(
            self._plan, clock, lambda name: Reports(record.error_writer(name), self._files.note), self._options.bus
        )
        self.ports = self._open_ports.enter_context(ports)
        for name, port in before.items():
            self.ports[name].counters.add(port.counters)
        return self._joined({name: RecordingPort(port, record.writer(name)) for name, port in self.ports.items()})

    def start_nodes(self) -> None:
        """Start the process of the emulated nodes, if there are any."""
        if not self._plan.setup.emulates:
            return
        self._options.say("start the emulated nodes")
        channels, origin_ns = list(self._plan.emulated_channels), self._record.origin_ns
        child = EmulatorChild(self._plan, self._options.out, channels, truth=self._wants_truth, origin_ns=origin_ns)
        self._stack.callback(self._end_nodes, child)
        child.start()
        self._child = child

    def await_nodes(self, port: Port, hear: Callable[[int, bytes, int], object]) -> None:
        """Wait for the boot-ups of the emulated nodes; `hear` gets each frame meanwhile."""
        if self._child is not None:
            self._child.await_boot_ups(port, self._options.say, hear)

    def _end_nodes(self, child: EmulatorChild) -> None:
        self.truth = child.end()
        self._files.note_unwritten(child.unwritten)


def make_buses(plan: Plan, options: RunOptions, files: KeptFiles, stack: ExitStack) -> SessionBuses:
    """The buses of a plan, not open yet; for the arguments see `SessionBuses`."""
    kinds = {DIRECT: NoBus, LOCKSTEP: VirtualBuses}
    return kinds.get(plan.scene.bus.interface, RealBuses)(plan, options, files, stack)


@contextmanager
def open_ports(
    plan: Plan, clock: Clock, reports: Callable[[str], Reports] = lambda _: Reports(), opened: Any = None
) -> Iterator[dict[str, Port]]:
    """The ports of a plan's buses, by channel; closed at the end.

    Args:
        plan: plan of the buses.
        clock: clock in real time.
        reports: makes the receivers of a port's reports, by channel.
        opened: a bus of python-can in the place of the plan's only one.

    Raises:
        UsageError: when the plan has several buses, and one is given.
        InterfaceError: when an interface is missing, down, or cannot be opened.
    """
    from canprobe.fieldbus.bus.real.opening import open_port

    bus = plan.scene.bus
    if opened is not None and len(plan.buses) > 1:
        raise UsageError(f"bus: one of python-can was given, and the scene has {len(plan.buses)}; name an interface")
    with ExitStack() as stack:
        ports: dict[str, Port] = {}
        for planned in plan.buses:
            name = planned.channel
            port = open_port(
                opened or bus.interface, name, bus.bitrate, clock, data_bitrate=data_bitrate(bus), reports=reports(name)
            )
            stack.callback(port.close)
            ports[name] = port
        yield ports


def lockstep_bus(scene: Scene, clock: VirtualClock, channel: str) -> LockstepBus:
    """A bus in virtual time, with the bit rate of the scene or without one."""
    bus = scene.bus
    if not bus.timed:
        return LockstepBus(clock, channel, fd=bus.fd is True)
    from canprobe.fieldbus.bus.virtual.controllers import BitErrors
    from canprobe.fieldbus.bus.virtual.timed import TimedBus

    errors = BitErrors(bus.bit_error_rate, scene.seed) if bus.bit_error_rate > 0 else None
    length = partial(exact_frame_bits, bus=bus) if bus.fd is True else exact_bits
    timed = TimedBus(clock, channel, bitrate=bus.bitrate, queue=bus.transmit_queue, errors=errors, length=length)
    timed.fd = bus.fd is True
    return timed
