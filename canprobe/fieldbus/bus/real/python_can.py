"""A `Port` over any interface of python-can, for adapters that SocketCAN does not drive.

Frames are stamped with the time at which they are taken from python-can, whose own stamps differ between interfaces.
A frame costs some 10 µs; for SocketCAN use `canprobe.fieldbus.bus.real.socketcan`.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence

import can

from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.clock import Clock
from canprobe.fieldbus.bus.port import (
    ERR_BUS,
    ERR_FLAG,
    ControllerState,
    PlainPort,
    PortCounters,
    Reports,
    TimedFrame,
    state_after,
)
from canprobe.fieldbus.bus.real.adapters import BACKENDS, SOCKETCAN, bus_options, interface_of, open_failure
from canprobe.fieldbus.protocol.frame_bits import FD_LENGTHS
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES, EFF_FLAG, EFF_MASK, RTR_FLAG, Frame

_MAX_ECHO_DELAY_NS = 1_000_000_000
_STATES = {
    can.BusState.ACTIVE: ControllerState.ACTIVE,
    can.BusState.PASSIVE: ControllerState.PASSIVE,
    can.BusState.ERROR: ControllerState.BUS_OFF,
}


class Echoes:
    """Our own frames on a bus that returns them: the first received frame that equals a sent one is its echo, once.

    A frame of another sender with the same identifier and data comes besides the echo, so one of the two is kept. An
    echo is expected for a second.
    """

    def __init__(self) -> None:
        self._waiting: dict[Frame, deque[int]] = {}

    def sent(self, frame: Frame, t_ns: int) -> None:
        """Note a frame that was sent."""
        self._waiting.setdefault(frame, deque()).append(t_ns)

    def is_one(self, frame: Frame, t_ns: int) -> bool:
        """Whether a received frame is the echo of a sent one, which then expects no other."""
        waiting = self._waiting.get(frame)
        while waiting and t_ns - waiting[0] > _MAX_ECHO_DELAY_NS:
            waiting.popleft()
        if not waiting:
            self._waiting.pop(frame, None)
            return False
        waiting.popleft()
        if not waiting:
            del self._waiting[frame]
        return True


class PythonCanPort(PlainPort):
    """One python-can bus.

    Args:
        interface: name of the interface in python-can, such as `virtual`, `pcan`, `slcan`; or a bus of python-can,
            which stays open.
        channel: channel in the words of that interface.
        bitrate: bit rate, bit/s, for interfaces that set it themselves.
        clock: clock for waits and stamps.
        data_bitrate: bit rate of the data phase of CAN FD frames; None: classical frames only.
        reports: receivers of error frames.

    Attributes:
        counters: counters of the port; `ignored` counts CAN FD frames where only classical ones are wanted.
        state: state of the controller by the last error frame.

    Raises:
        UsageError: python-can has no such interface.
        InterfaceError: python-can cannot open it, with its reason.
    """

    def __init__(
        self,
        interface: str | can.BusABC,
        channel: str,
        bitrate: int,
        clock: Clock,
        *,
        data_bitrate: int | None = None,
        reports: Reports | None = None,
    ) -> None:
        self._fd = data_bitrate is not None
        self._reports = reports or Reports()
        name = interface if isinstance(interface, str) else interface_of(interface)
        features = BACKENDS[name].features if name in BACKENDS else ()
        self._has_classes = "error-classes" in features
        self._hears_neighbours = name == SOCKETCAN  # which are marked as if this port had sent their frames
        self.clock = clock
        self.channel = channel
        self.counters = PortCounters()
        self.state = ControllerState.ACTIVE
        self._arrived: deque[can.Message] = deque()
        self._echoes = Echoes() if "echo" in features else None
        self._owns = isinstance(interface, str)
        opened = _open(interface, channel, bitrate, data_bitrate) if isinstance(interface, str) else interface
        self._bus: can.BusABC | None = opened

    stamps_arrival = False

    def send_batch(self, frames: Sequence[Frame], t_ns: int | None = None) -> None:
        """Send `frames` in order, each with one call of python-can."""
        bus = self._open_bus()
        for can_id, data in frames:
            message = _message(self.channel, can_id, data, self._fd)
            try:
                bus.send(message)
            except (can.CanError, OSError) as error:
                self.counters.transmit_full += 1
                raise InterfaceError(f"{self.channel}: sending {can_id:03X} failed: {error}") from error
            self.counters.sent += 1
            if self._echoes is not None:
                self._echoes.sent((can_id, data), self.clock.now_ns())

    def drain(self) -> list[TimedFrame]:
        """Return everything that has arrived, stamped now."""
        bus = self._open_bus()
        arrived = self._arrived
        while (message := self._receive(bus, 0.0)) is not None:
            arrived.append(message)
        t_ns = self.clock.now_ns()
        frames = [frame for message in arrived if (frame := self._frame(message, t_ns)) is not None]
        arrived.clear()
        if self._echoes is not None:
            frames = [frame for frame in frames if not self._echoes.is_one(frame[:2], t_ns)]
        self.counters.received += len(frames)
        return frames

    def wait(self, until_ns: int) -> None:
        """Wait for a frame, until `until_ns` at the latest."""
        bus = self._open_bus()
        while not self._arrived and (left_ns := until_ns - self.clock.now_ns()) > 0:
            message = self._receive(bus, left_ns * 1e-9)
            if message is not None:
                self._arrived.append(message)

    def close(self) -> None:
        """Shut the python-can bus down, unless it was open before."""
        bus, self._bus = self._bus, None
        if bus is not None and self._owns:
            bus.shutdown()

    def _open_bus(self) -> can.BusABC:
        if self._bus is None:
            raise InterfaceError(f"{self.channel}: this port is closed")
        return self._bus

    def _receive(self, bus: can.BusABC, timeout_s: float) -> can.Message | None:
        try:
            # BusABC.recv goes by the wall clock: set back meanwhile, it waits as much longer. No filters are set here.
            return bus._recv_internal(timeout_s)[0]
        except (can.CanError, OSError) as error:
            raise InterfaceError(f"{self.channel}: receiving failed: {error}") from error

    def _frame(self, message: can.Message, t_ns: int) -> TimedFrame | None:
        if message.is_error_frame:
            self._note_error(message, t_ns)
            return None
        if not message.is_rx and not self._hears_neighbours:
            return None
        if message.is_fd and not self._fd:
            self.counters.ignored += 1
            return None
        can_id = message.arbitration_id
        if message.is_extended_id:
            can_id |= EFF_FLAG
        if message.is_remote_frame:
            return can_id | RTR_FLAG, b"", t_ns
        return can_id, bytes(message.data), t_ns

    def _note_error(self, message: can.Message, t_ns: int) -> None:
        data = bytes(message.data)
        if self._has_classes:
            can_id = ERR_FLAG | message.arbitration_id
            self.state = state_after(self.state, can_id, data)
        else:
            can_id = ERR_FLAG | ERR_BUS
            self.state = _STATES.get(self._open_bus().state, self.state)
        self.counters.note_error(can_id, data)
        self._reports.error_frame(can_id, data, t_ns)


def _open(interface: str, channel: str, bitrate: int, data_bitrate: int | None) -> can.BusABC:
    logging.getLogger("can").setLevel(logging.CRITICAL)
    options = bus_options(interface, channel, bitrate, data_bitrate)
    if interface == "virtual" and data_bitrate is not None:
        options |= {"protocol": can.CanProtocol.CAN_FD}
    try:
        return can.Bus(**options)
    except Exception as error:  # where the library of a driver is missing, python-can raises anything
        why = open_failure(interface, channel, error)
        raise InterfaceError(f"{channel}: {interface} cannot be opened: {why}") from error


def _message(channel: str, can_id: int, data: bytes, fd: bool) -> can.Message:
    extended = bool(can_id & EFF_FLAG)
    long = len(data) > CLASSIC_BYTES
    try:
        if long and fd and len(data) not in FD_LENGTHS:
            raise ValueError(f"CAN FD has {', '.join(map(str, FD_LENGTHS))}")
        return can.Message(
            arbitration_id=can_id & (EFF_MASK if extended else ~RTR_FLAG),
            data=data,
            is_extended_id=extended,
            is_remote_frame=bool(can_id & RTR_FLAG),
            is_fd=fd and long,
            bitrate_switch=fd and long,
            check=True,
        )
    except ValueError as error:
        what = f"{can_id:X} with {len(data)} bytes is no {'CAN or CAN FD' if fd else 'classic CAN'} frame"
        raise InterfaceError(f"{channel}: {what}: {error}") from error
