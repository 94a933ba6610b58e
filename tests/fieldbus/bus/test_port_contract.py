"""One contract for every `Port`: the same assertions on lockstep, python-can's virtual bus, and real SocketCAN."""

from __future__ import annotations

import errno
import socket
import uuid
from collections.abc import Callable, Iterator, Sequence

import can
import pytest
from can.interfaces.pcan.pcan import PcanCanOperationError
from can.interfaces.vector.exceptions import VectorOperationError

from canprobe.errors import BusError, InterfaceError, UsageError
from canprobe.fieldbus import LockstepBus, MonotonicClock, VirtualClock, open_port
from canprobe.fieldbus.bus.port import ControllerState, Port, Reports, TimedFrame
from canprobe.fieldbus.bus.real.python_can import PythonCanPort
from canprobe.fieldbus.protocol.frames import EFF_FLAG, RTR_FLAG

HOUR_NS = 3600 * 10**9
BITRATE = 1_000_000

PortMaker = Callable[[], Port]


def lockstep() -> PortMaker:
    return LockstepBus(VirtualClock(), "can0").port


def virtual() -> PortMaker:
    channel = uuid.uuid4().hex
    return lambda: open_port("virtual", channel, BITRATE, MonotonicClock())


def udp_multicast_opened_by_its_user() -> PortMaker:
    """Buses that are handed over, on an interface that gives a sender its own frames back."""
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as free:
        free.bind(("::1", 0))
        where = {"channel": f"ff11::{uuid.uuid4().hex[:4]}", "port": free.getsockname()[1], "hop_limit": 0}

    def make() -> Port:
        bus = can.Bus(interface="udp_multicast", **where)
        port = open_port(bus, "opened before", BITRATE, MonotonicClock())

        def close() -> None:
            PythonCanPort.close(port)
            bus.shutdown()

        port.close = close
        return port

    return make


def socketcan() -> PortMaker:
    return lambda: open_port("socketcan", "vcan0", BITRATE, MonotonicClock())


def python_can_socketcan() -> PortMaker:
    return lambda: PythonCanPort("socketcan", "vcan0", BITRATE, MonotonicClock())


@pytest.fixture(
    params=[
        lockstep,
        virtual,
        udp_multicast_opened_by_its_user,
        pytest.param(socketcan, marks=pytest.mark.vcan),
        pytest.param(python_can_socketcan, marks=pytest.mark.vcan),
    ],
    ids=lambda maker: maker.__name__,
)
def ports(request: pytest.FixtureRequest) -> Iterator[tuple[Port, Port]]:
    make = request.param()
    one, two = make(), make()
    yield one, two
    one.close()
    two.close()


def receive(port: Port, count: int) -> list[TimedFrame]:
    """Wait for `count` frames; the hour ends only a test that fails."""
    frames: list[TimedFrame] = []
    limit_ns = port.clock.now_ns() + HOUR_NS
    while len(frames) < count and port.clock.now_ns() < limit_ns:
        port.wait(limit_ns)
        frames += port.drain()
    return frames


def test_a_batch_arrives_whole_and_in_order(ports: tuple[Port, Port]) -> None:
    one, two = ports
    batch = [(0x700 - k % 7, bytes([k]) * (k % 9)) for k in range(150)]
    one.send_batch(batch)
    assert [(can_id, data) for can_id, data, _ in receive(two, 150)] == batch


def test_an_empty_batch_is_nothing(ports: tuple[Port, Port]) -> None:
    one, two = ports
    one.send_batch([])
    one.send_batch(())
    one.send_batch([(0x123, b"x")])
    assert len(receive(two, 1)) == 1


def test_drain_empties(ports: tuple[Port, Port]) -> None:
    one, two = ports
    assert two.drain() == []
    one.send_batch([(0x123, b"a")])
    first = receive(two, 1)
    assert [(i, d) for i, d, _ in first] == [(0x123, b"a")]
    assert two.drain() == []
    first.append((0, b"", 0))  # the list is the caller's own
    assert two.drain() == []


def test_a_port_does_not_hear_itself(ports: tuple[Port, Port]) -> None:
    one, two = ports
    one.send_batch([(0x123, b"mine")])
    receive(two, 1)
    two.send_batch([(0x124, b"yours")])
    assert [(i, d) for i, d, _ in receive(one, 1)] == [(0x124, b"yours")]


def test_wide_identifiers_and_remote_requests_keep_their_flags(ports: tuple[Port, Port]) -> None:
    one, two = ports
    batch = [(0x7FF, b""), (5 | EFF_FLAG, b"\1"), (0x9FFFFFFF, b"\2"), (0x701 | RTR_FLAG, b""), (0x000, bytes(8))]
    one.send_batch(batch)
    assert [(i, d) for i, d, _ in receive(two, 5)] == batch


def test_wait_ends_on_arrival(ports: tuple[Port, Port]) -> None:
    one, two = ports
    one.send_batch([(0x123, b"x")])
    limit_ns = two.clock.now_ns() + HOUR_NS
    two.wait(limit_ns)
    assert two.clock.now_ns() < limit_ns
    two.wait(limit_ns)  # nothing was fetched: it is still there
    assert two.clock.now_ns() < limit_ns
    assert len(two.drain()) == 1


def test_wait_ends_at_its_limit(ports: tuple[Port, Port]) -> None:
    _, two = ports
    limit_ns = two.clock.now_ns() + 3_000_000
    two.wait(limit_ns)
    assert two.clock.now_ns() >= limit_ns
    two.wait(limit_ns - 1_000_000)
    two.wait(-1)
    assert two.drain() == []


def test_stamps_lie_between_sending_and_draining(ports: tuple[Port, Port]) -> None:
    one, two = ports
    before_ns = one.clock.now_ns()
    one.send_batch([(0x100 + k, b"") for k in range(10)])
    frames = receive(two, 10)
    after_ns = two.clock.now_ns()
    stamps = [t_ns for _, _, t_ns in frames]
    allowance_ns = 1_000_000  # two clocks are compared, and reading one takes its time
    assert before_ns - allowance_ns <= stamps[0] <= stamps[-1] <= after_ns + allowance_ns
    assert stamps == sorted(stamps)


@pytest.mark.parametrize("frame", [(0x123, bytes(9)), (0x123, bytes(64))])
def test_what_classic_can_cannot_carry_is_refused(ports: tuple[Port, Port], frame: tuple[int, bytes]) -> None:
    one, two = ports
    with pytest.raises(BusError, match="123"):
        one.send_batch([frame])
    one.send_batch([(0x124, b"")])
    assert [i for i, _, _ in receive(two, 1)] == [0x124]


def test_closing_twice_is_allowed_and_everything_else_is_not(ports: tuple[Port, Port]) -> None:
    one, _ = ports
    one.close()
    one.close()
    for use in (lambda: one.send_batch([(1, b"")]), one.drain, lambda: one.wait(0)):
        with pytest.raises(InterfaceError, match=f"{one.channel}: this port is closed"):
            use()


def test_error_frames_without_classes_are_bus_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    """pcan's 1, 2, 4 and 8 are bit, form, stuff and other errors: nothing that Linux means by these bits."""
    told = []
    reports = Reports(error_frame=lambda can_id, data, _: told.append((can_id, data)))
    port = PythonCanPort("virtual", "classless", BITRATE, MonotonicClock(), reports=reports)
    with can.Bus(interface="virtual", channel="classless") as other:
        for arbitration_id in (1, 2, 4):
            other.send(can.Message(arbitration_id=arbitration_id, is_error_frame=True))
        assert port.drain() == [] and port.state is ControllerState.ACTIVE
        monkeypatch.setattr(can.BusABC, "state", can.BusState.PASSIVE)
        other.send(can.Message(arbitration_id=8, is_error_frame=True))
        assert port.drain() == [] and port.state is ControllerState.PASSIVE
    assert told == [(0x20000080, b"")] * 4
    assert (port.counters.error_frames, port.counters.overruns, port.counters.received) == (4, 0, 0)
    port.close()


class FakeAdapter(can.BusABC):
    """A bus that raises what the back-end of an adapter raises, and receives what it is told."""

    def __init__(self, error: Exception | None = None, received: Sequence[can.Message] = ()) -> None:
        self.error, self.received = error, list(received)
        self.state_now = can.BusState.ACTIVE
        super().__init__("fake")

    @property
    def state(self) -> can.BusState:
        return self.state_now

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        if self.error is not None:
            raise self.error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self.error is not None and not self.received:
            raise self.error
        return (self.received.pop(0) if self.received else None), False


@pytest.mark.parametrize(
    "error",
    [
        can.CanOperationError("Failed to transmit: No buffer space available", errno.ENOBUFS),  # socketcan: full queue
        PcanCanOperationError("The transmit queue is full"),
        PcanCanOperationError("The driver is not loaded"),
        VectorOperationError(11, "XL_ERR_QUEUE_IS_FULL", "xlCanTransmit"),
        OSError(errno.ENODEV, "No such device (it may have been disconnected)"),  # usb.core.USBError, SerialException
        can.CanTimeoutError("transmit timed out"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_what_a_back_end_raises_is_an_error_of_the_interface(error: Exception) -> None:
    with FakeAdapter(error) as bus:
        port = open_port(bus, "adapter", BITRATE, MonotonicClock())
        with pytest.raises(InterfaceError, match=r"^adapter: sending 701 failed: "):
            port.send_batch([(0x701, b"\5")])
        for use in (port.drain, lambda: port.wait(port.clock.now_ns() + 1_000_000_000)):
            with pytest.raises(InterfaceError, match=r"^adapter: receiving failed: "):
                use()
        assert (port.counters.transmit_full, port.counters.sent) == (1, 0)
        port.close()
        assert not bus._is_shutdown, "its user opened it"


def test_a_bus_off_and_what_an_adapter_sent_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """gs_usb and cantact give a sender its frames back, marked; python-can's state says that the bus is off."""
    own = can.Message(arbitration_id=0x080, is_extended_id=False, is_rx=False)
    other = can.Message(arbitration_id=0x701, data=[5], is_extended_id=False)
    with FakeAdapter(received=[own, other, can.Message(is_error_frame=True)]) as bus:
        bus.state_now = can.BusState.ERROR
        port = open_port(bus, "adapter", BITRATE, MonotonicClock())
        assert [frame[:2] for frame in port.drain()] == [(0x701, b"\5")]
        assert port.state is ControllerState.BUS_OFF and port.counters.received == 1


class GsUsbBus(FakeAdapter):
    """Its error frames have the classes of SocketCAN, as those of python-can's class of this name."""


class SocketCanDaemonBus(FakeAdapter):
    """The same."""


@pytest.mark.parametrize("kind", [GsUsbBus, SocketCanDaemonBus])
def test_error_frames_with_classes_are_read_by_them(kind: type[FakeAdapter]) -> None:
    off = can.Message(arbitration_id=0x040, is_error_frame=True, data=[0])
    lost = can.Message(arbitration_id=0x002, is_error_frame=True, data=[0])  # arbitration, which is no error
    with kind(received=[lost, off]) as bus:
        port = open_port(bus, "adapter", BITRATE, MonotonicClock())
        assert port.drain() == [] and port.state is ControllerState.BUS_OFF
        assert port.counters.error_frames == 0


@pytest.mark.parametrize(
    ("interface", "channel", "message"),
    [
        ("serial", "/dev/no-such-port", "/dev/no-such-port: serial cannot be opened"),
        ("socketcan", "nosuch0", "nosuch0: (this kernel has no SocketCAN|no such interface)"),
        pytest.param("socketcan", "vcan9", "vcan9: no such interface; type: .*ip link add", marks=pytest.mark.vcan),
        pytest.param("socketcan", "can9", "can9: no such interface; is the adapter plugged", marks=pytest.mark.vcan),
        pytest.param("socketcan", "lo", "lo: not a CAN interface", marks=pytest.mark.vcan),
        pytest.param("socketcan", "a-very-long-interface", "no such interface", marks=pytest.mark.vcan),
    ],
)
def test_a_missing_interface_is_named(interface: str, channel: str, message: str) -> None:
    with pytest.raises(InterfaceError, match=message) as caught:
        open_port(interface, channel, BITRATE, MonotonicClock())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("interface", "message"),
    [
        ("lockstep", "can0: a lockstep bus lives inside one run"),
        ("virtuel", "no interface 'virtuel'; did you mean virtual.*python-can has: .*virtual"),
    ],
)
def test_an_interface_that_there_cannot_be_is_wrong_usage(interface: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        open_port(interface, "can0", BITRATE, MonotonicClock())
    assert "\n" not in str(caught.value)
