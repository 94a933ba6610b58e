"""A bus for a test: emulated nodes from EDS files with faults, a network of canopen-python, and a log of the frames.

In virtual time all of it lives in one thread, on a lockstep bus. On a real interface, a vcan for example, a thread
serves the nodes and another one writes the log; the master under test may live in any process.
"""

from __future__ import annotations

import struct
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, ExitStack, closing
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import TypeVar

import canopen

from canprobe.errors import InterfaceError, UsageError
from canprobe.fieldbus.bus.candump import CandumpWriter, read_candump
from canprobe.fieldbus.bus.canopen_network import PortNetwork
from canprobe.fieldbus.bus.clock import Clock, MonotonicClock, VirtualClock
from canprobe.fieldbus.bus.port import Port, TimedFrame
from canprobe.fieldbus.bus.real.opening import open_port
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus
from canprobe.fieldbus.drive.from_eds import make_eds_node
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.node.dictionary import Value, key_of
from canprobe.fieldbus.node.serve import serve
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.sdo import SdoAbort
from canprobe.fieldbus.tools.faults import Fault, FaultyNode, FaultyNodes
from canprobe.fieldbus.tools.faults.text import node_of

T = TypeVar("T")
Requests = SimpleQueue[Callable[[], None]]
_LOOK_NS = 50_000_000
_PATIENCE_S = 5.0


def _answer(future: Future[T], act: Callable[[], T]) -> None:
    """Act, and give the one who waits the result or the error."""
    try:
        future.set_result(act())
    except Exception as error:
        future.set_exception(error)


class EmulatedBus(AbstractContextManager["EmulatedBus"]):
    """The bus of a test. A context manager; leaving it closes everything on it.

    Args:
        channel: name of the channel.
        clock: clock of the bus.
        log: path of the candump log.

    Attributes:
        faulty: the emulated nodes.
        descriptions: what the EDS files say, by node id.
        log: path of the candump log, whose time is 0 when the bus opens. It has each frame as soon as it was carried.
    """

    def __init__(self, channel: str, clock: Clock, log: Path) -> None:
        self.channel, self.clock, self.log = channel, clock, log
        self.start_ns = clock.now_ns()
        self.faulty = FaultyNodes([])
        self.descriptions: dict[int, Description] = {}
        self._stack = ExitStack()
        self._writer = self._stack.enter_context(CandumpWriter(log, channel, self.start_ns))

    def add_nodes(self, files: Sequence[tuple[str | Path, int]]) -> list[EmulatedNode]:
        """Power on a node from each EDS file.

        Args:
            files: (name or path of an EDS, DCF, XDD or XDC file, node id) of each node.

        Raises:
            EdsError: a file cannot be served.
            UsageError: a node id is taken.
        """
        nodes = [EmulatedNode(make_eds_node(load_eds(name, node_id), node_id), self) for name, node_id in files]
        self.power_on(nodes)
        self.descriptions |= {node_id: Description(load_eds(name, node_id)) for name, node_id in files}
        return nodes

    def power_on(self, nodes: Sequence[FaultyNode]) -> None:
        """Put nodes on the bus, such as nodes with an application of your own; they have booted when it returns.

        Raises:
            UsageError: a node id is taken.
        """
        if taken := {node.node_id for node in nodes} & {node.node_id for node in self.faulty.nodes}:
            raise UsageError(f"node {min(taken)} is on this bus already: give the new one another id")
        self.faulty.nodes += nodes
        self._attach(nodes)

    def inject(self, text: str) -> Fault:
        """Throw a fault, as `parse_fault` reads it; its times count from now.

        Raises:
            UsageError: the text is wrong, there is no such node, or the kind needs another device.
        """
        return self._act(node_of(text), lambda: self.faulty.inject(text, self.clock.now_ns()))

    def end(self, fault: Fault) -> None:
        """End a fault at the next frame or deadline of its node."""
        self._act(fault.node_id, partial(self.faulty.end, fault))

    def act(self, node: FaultyNode, do: Callable[[SlaveNode], T]) -> T:
        """Let a device do something by itself, now; return what `do` returns. Its frames are sent."""
        done: Future[T] = Future()
        self._act(node.node_id, partial(node.act, lambda slave: _answer(done, partial(do, slave))))
        self._wake()
        return done.result(_PATIENCE_S)

    def frames(self) -> list[TimedFrame]:
        """The frames of the bus until now: identifier, data, and time since the bus opened, ns."""
        self.flush()
        return [(can_id, data, t_ns) for t_ns, _, can_id, data in read_candump(self.log)]

    @abstractmethod
    def network(self) -> canopen.Network:
        """A connected network of canopen-python with a method `pass_time(seconds)`."""

    @abstractmethod
    def port(self) -> Port:
        """A port for frames by hand; the bus closes it."""

    def flush(self) -> None:
        """Write to the log what was recorded so far."""
        self._act(0, self._writer.flush)

    @abstractmethod
    def _wake(self) -> None:
        """Let nodes do at once what has become due."""

    @abstractmethod
    def _attach(self, nodes: Sequence[FaultyNode]) -> None: ...

    @abstractmethod
    def _act(self, node_id: int, act: Callable[[], T]) -> T:
        """Do something to a node, or to the log (0), between two frames."""

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._stack.close()


class EmulatedNode(FaultyNode):
    """A node of the bus of a test, whose values a test reads and sets as the device itself does.

        io[0x6401, 1] = 1234      # an analog input; a TPDO of an event goes out
        io.emcy(0x5000)           # a fault of the hardware; io.emcy(0) ends it

    A drive computes its position, velocity and statusword itself: what a test sets there lasts for an instant.

    Args:
        node: the node.
        bus: the bus.
    """

    def __init__(self, node: SlaveNode, bus: EmulatedBus) -> None:
        super().__init__(node)
        self._bus = bus

    def __getitem__(self, place: int | tuple[int, int]) -> Value:
        """The value of an entry: `node[0x6041]`, `node[0x6401, 1]`. Raises UsageError where the EDS has none."""
        index, subindex = self._known(place)
        return self._bus.act(
            self, lambda node: node.dictionary.find(index, subindex).from_bytes(node.dictionary.read(index, subindex))
        )

    def __setitem__(self, place: int | tuple[int, int], value: Value) -> None:
        """Set the value of an entry. Raises UsageError where the EDS has none, or its type does not hold the value."""
        index, subindex = self._known(place)
        entry = self.node.dictionary.find(index, subindex)
        try:
            entry.from_bytes(entry.to_bytes(value))
        except (SdoAbort, OverflowError, TypeError, ValueError, struct.error) as error:
            kind = "bytes" if not entry.bits else f"a number of {entry.bits} bits, {'' if entry.signed else 'un'}signed"
            raise UsageError(f"{self.name}: {index:04X}h:{subindex:02X}: expected {kind}, got {value!r}") from error

        def put(node: SlaveNode) -> None:
            node.dictionary.put(index, subindex, value)
            node.pdos.event(index, subindex)

        self._bus.act(self, put)

    def emcy(self, code: int, data: bytes = b"") -> None:
        """Report an error by EMCY, 1001h and 1003h, once until it ends; with code 0 end all errors.

        Args:
            code: emergency error code.
            data: bytes of the manufacturer, up to five.
        """

        def report(node: SlaveNode) -> None:
            if code:
                node.emcy.report(code, data)
            for one in () if code else node.emcy.active:
                node.emcy.clear(one)

        self._bus.act(self, report)

    def _known(self, place: int | tuple[int, int]) -> tuple[int, int]:
        index, subindex = (place, 0) if isinstance(place, int) else place
        if key_of(index, subindex) not in self.node.dictionary:
            raise UsageError(f"{self.name}: its EDS has no {index:04X}h:{subindex:02X}")
        return index, subindex


class VirtualTimeBus(EmulatedBus):
    """A bus in virtual time: nodes answer at once, and time passes in `pass_time` and in the waits of ports."""

    def __init__(self, log: Path) -> None:
        self._bus = LockstepBus(VirtualClock(), "can0")
        super().__init__(self._bus.channel, self._bus.clock, log)
        self._bus.recorder = self._record

    def network(self) -> canopen.Network:
        """A network without a thread: see `PortNetwork`."""
        return PortNetwork(self.port())

    def port(self) -> Port:
        return self._stack.enter_context(closing(self._bus.port()))

    def _attach(self, nodes: Sequence[FaultyNode]) -> None:
        for node in nodes:
            self._bus.attach(node)
        self._bus.settle()

    def _act(self, node_id: int, act: Callable[[], T]) -> T:
        self._bus.settle()
        return act()

    def _wake(self) -> None:
        self._bus.next_deadline_ns()  # the bus looks at the deadlines anew
        self._bus.settle()

    def _record(self, can_id: int, data: bytes, t_ns: int) -> None:
        self._writer.write(can_id, data, t_ns)
        self._writer.flush()


class RealTimeNetwork(canopen.Network):
    """A network of canopen-python in real time."""

    NOTIFIER_CYCLE = 0.05  # s; `disconnect` waits for the end of one

    def pass_time(self, seconds: float) -> None:
        """Sleep; the network's own thread receives meanwhile."""
        time.sleep(seconds)


class ServedBus(EmulatedBus):
    """A bus on a real interface.

    Args:
        interface: interface, as `open_port` takes it.
        channel: channel in its words.
        bitrate: bit rate, bit/s.
        log: path of the candump log.

    Raises:
        InterfaceError: there is no such interface, or it is down.
    """

    def __init__(self, interface: str, channel: str, bitrate: int, log: Path) -> None:
        super().__init__(channel, MonotonicClock(), log)
        self._interface, self._bitrate = interface, bitrate
        self._ended = threading.Event()
        self._threads = ExitStack()
        self._requests_of: dict[int, Requests] = {}
        self._failures: list[BaseException] = []
        try:
            listener = self.port()
        except BaseException:
            self._stack.close()
            raise
        self._start([0], partial(self._record, listener))

    def network(self) -> canopen.Network:
        network = RealTimeNetwork()
        network.connect(interface=self._interface, channel=self.channel, bitrate=self._bitrate)
        self._stack.callback(network.disconnect)
        return network

    def port(self) -> Port:
        port = open_port(self._interface, self.channel, self._bitrate, self.clock, waits=True)
        return self._stack.enter_context(closing(port))

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._ended.set()
        self._threads.close()
        super().__exit__(kind, error, trace)
        if self._failures and error is None:
            raise self._failures[0]

    def _attach(self, nodes: Sequence[FaultyNode]) -> None:
        self._start([node.node_id for node in nodes], partial(serve, [(nodes, self.port())]))
        self._act(nodes[0].node_id, lambda: None)  # they have booted when the thread looks for requests

    def _record(self, port: Port, ended: Callable[[], bool]) -> None:
        while not ended():
            for frame in port.wait_and_drain(self.clock.now_ns() + _LOOK_NS):
                self._writer.write(*frame)
            self._writer.flush()

    def _act(self, node_id: int, act: Callable[[], T]) -> T:
        if node_id not in self._requests_of:  # no such node: a fault that says so
            return act()
        future: Future[T] = Future()
        self._requests_of[node_id].put(partial(_answer, future, act))
        try:
            return future.result(_PATIENCE_S)
        except TimeoutError:
            why = self._failures[0] if self._failures else None
            raise InterfaceError(f"{self.channel}: the emulated nodes are not served any more") from why

    def _wake(self) -> None:
        pass  # the thread of the nodes looks at their deadlines after each request

    def _start(self, node_ids: Sequence[int], loop: Callable[[Callable[[], bool]], None]) -> None:
        """Start a thread with a loop that asks after each wait whether to end; then it does what is requested."""
        requests: Requests = SimpleQueue()

        def ended() -> bool:
            while not requests.empty():
                requests.get()()
            return self._ended.is_set()

        def run() -> None:
            try:
                loop(ended)
            except BaseException as error:
                self._failures.append(error)

        thread = threading.Thread(target=run, name=f"{self.channel} {node_ids}")
        self._requests_of |= dict.fromkeys(node_ids, requests)
        self._threads.callback(thread.join)
        thread.start()
