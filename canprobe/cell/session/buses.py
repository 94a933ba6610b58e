"""Buses that a session opens: ports, buses in virtual time, routes between several buses, counters of frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial

from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.wire_time import exact_frame_bits
from canprobe.cell.scene.model import Scene
from canprobe.cell.session.link_faults import data_bitrate
from canprobe.fieldbus.bus.clock import Clock, VirtualClock
from canprobe.fieldbus.bus.port import Port, Reports, TimedFrame
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus
from canprobe.fieldbus.protocol.frame_bits import best_case_bits, best_case_fd_bits, exact_bits
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, SDO_RX_BASE, SDO_TX_BASE


class TrafficCounter:
    """Counts frames and bits of a bus in real time; bits without stuffing, as `canbusload -i` counts.

    Args:
        speed_up: data bit rate of CAN FD over the nominal one.

    Attributes:
        error_frames: number of bus errors; whoever receives one counts it here.
    """

    def __init__(self, speed_up: float) -> None:
        self._by_length = [0] * 65
        self._speed_up = speed_up
        self.error_frames = 0

    @property
    def frames(self) -> int:
        """Number of frames so far."""
        return sum(self._by_length)

    @property
    def bits(self) -> int:
        """Number of bits so far, those of a data phase in bits of the nominal rate."""
        classic = sum(count * best_case_bits(n) for n, count in enumerate(self._by_length[:9]))
        long = [(count, best_case_fd_bits(n)) for n, count in enumerate(self._by_length[9:], start=9) if count]
        return classic + round(sum(count * (bits.nominal + bits.data / self._speed_up) for count, bits in long))

    def write(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Count one frame."""
        self._by_length[len(data)] += 1

    def take(self, frames: Sequence[TimedFrame]) -> None:
        """Count several frames."""
        for _, data, _ in frames:
            self._by_length[len(data)] += 1


@contextmanager
def open_ports(
    plan: Plan, clock: Clock, reports: Callable[[str], Reports] = lambda _: Reports()
) -> Iterator[dict[str, Port]]:
    """The ports of a plan's buses, by channel; closed at the end.

    Args:
        plan: plan of the buses.
        clock: clock in real time.
        reports: makes the receivers of a port's reports, by channel.

    Raises:
        InterfaceError: when an interface is missing, down, or cannot be opened.
    """
    from canprobe.fieldbus.bus.real.opening import open_port

    bus = plan.scene.bus
    with ExitStack() as stack:
        ports: dict[str, Port] = {}
        for planned in plan.buses:
            name = planned.channel
            port = open_port(
                bus.interface, name, bus.bitrate, clock, data_bitrate=data_bitrate(bus), reports=reports(name)
            )
            stack.callback(port.close)
            ports[name] = port
        yield ports


def channel_routes(plan: Plan) -> dict[int, str]:
    """Channel of each identifier that only one node sends or reads."""
    routes = {frames.can_id: frames.channel for frames in plan.raw}
    routes |= {pdo.cob_id: pdo.channel for pdo in plan.pdos}
    for node in plan.nodes:
        for base in (SDO_RX_BASE, SDO_TX_BASE, EMCY_BASE, HEARTBEAT_BASE):
            routes[base + node.node_id] = node.channel
    return routes


def lockstep_bus(scene: Scene, clock: VirtualClock, channel: str) -> LockstepBus:
    """A bus in virtual time, with the bit rate of the scene or without one."""
    if not scene.bus.timed:
        return LockstepBus(clock, channel, fd=scene.bus.fd is True)
    from canprobe.fieldbus.bus.virtual.bit_errors import BitErrors
    from canprobe.fieldbus.bus.virtual.timed import TimedBus

    rate = scene.bus.bit_error_rate
    errors = BitErrors(rate, scene.seed) if rate > 0 else None
    bus = scene.bus
    length = partial(exact_frame_bits, bus=bus) if bus.fd is True else exact_bits
    timed = TimedBus(clock, channel, bitrate=bus.bitrate, queue=bus.transmit_queue, errors=errors, length=length)
    timed.fd = bus.fd is True
    return timed
