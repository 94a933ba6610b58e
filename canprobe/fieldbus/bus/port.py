"""A CAN bus as the cycle sees it: frames out in batches, frames in with their time, and a wait.

A frame is `(can_id, data)`. Identifiers above 11 bits and remote requests carry the flags of Linux's `struct
can_frame`: `EFF_FLAG` for a 29-bit identifier, `RTR_FLAG` for a remote request; plain data frames are the bare
identifier. Error frames are never passed on as frames: a hardware port reads their class bits, counts bus errors and
lost frames, shows its controller's state, and gives each of them to `Reports.error_frame`, for a log.

Source: Linux include/uapi/linux/can/error.h (error classes).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Protocol

from canprobe.fieldbus.bus.clock import Clock
from canprobe.fieldbus.protocol.frames import Frame

ERR_FLAG = 0x20000000
ERR_CONTROLLER, ERR_PROTOCOL, ERR_ACK, ERR_BUS_OFF, ERR_BUS, ERR_RESTARTED = 0x004, 0x008, 0x020, 0x040, 0x080, 0x100
_BUS_ERRORS = ERR_PROTOCOL | ERR_ACK | ERR_BUS
_OVERFLOWS, _WARNINGS, _PASSIVES, _ACTIVE = 0x03, 0x0C, 0x30, 0x40
"""Bits of the second byte of an ERR_CONTROLLER frame, each for reception and transmission."""

TimedFrame = tuple[int, bytes, int]
"""A received frame: can_id, data, time of reception in ns on the port's clock."""


class ControllerState(IntEnum):
    """Error state of the CAN controller, as far as error frames show it (ISO 11898-1 fault confinement)."""

    ACTIVE = 0
    WARNING = 1
    PASSIVE = 2
    BUS_OFF = 3


def is_bus_error(can_id: int) -> bool:
    """Whether an error frame reports a frame that went wrong: protocol, acknowledgement or bit error.

    A lost arbitration, which some drivers report every time, and a change of the controller's state do not count.
    """
    return bool(can_id & ERR_FLAG and can_id & _BUS_ERRORS)


def state_after(state: ControllerState, can_id: int, data: bytes) -> ControllerState:
    """The controller's state after an error frame."""
    if can_id & ERR_BUS_OFF:
        return ControllerState.BUS_OFF
    if can_id & ERR_RESTARTED:
        return ControllerState.ACTIVE
    for bits, reported in (
        (_PASSIVES, ControllerState.PASSIVE),
        (_WARNINGS, ControllerState.WARNING),
        (_ACTIVE, ControllerState.ACTIVE),
    ):
        if _of_controller(can_id, data) & bits:
            return reported
    return state


def _of_controller(can_id: int, data: bytes) -> int:
    return data[1] if can_id & ERR_CONTROLLER and len(data) > 1 else 0


@dataclass(slots=True)
class PortCounters:
    """Counters of a port since it was opened.

    Attributes:
        sent: number of frames that were handed to the bus.
        received: number of data and remote frames that were given to the reader.
        error_frames: number of bus errors, as error frames report them.
        overruns: number of frames that were lost on this machine: dropped by the kernel because the reader was late, or
            lost in an overflow of the controller's buffers.
        transmit_full: number of times that the transmit queue was full, with retries.
        ignored: number of frames that classical CAN cannot carry (CAN FD) and that were dropped.
        clock_steps: number of times that the wall clock, by which the kernel stamps frames, was set.
    """

    sent: int = 0
    received: int = 0
    error_frames: int = 0
    overruns: int = 0
    transmit_full: int = 0
    ignored: int = 0
    clock_steps: int = 0

    def add(self, other: PortCounters) -> None:
        """Add the counters of a port that was open before on the same bus."""
        for field in fields(self):
            setattr(self, field.name, getattr(self, field.name) + getattr(other, field.name))

    def note_error(self, can_id: int, data: bytes) -> None:
        """Count an error frame by its class; an overflow is one lost frame, received or sent."""
        self.error_frames += is_bus_error(can_id)
        self.overruns += bool(_of_controller(can_id, data) & _OVERFLOWS)


def nothing(*_: object) -> None:
    """Do nothing, as a callback that nobody has set."""


@dataclass(frozen=True, slots=True)
class Reports:
    """Receivers of what a port does not give to its reader.

    Attributes:
        error_frame: function that is called with (can_id, data, t_ns) of every error frame.
        say: function that is called with each message for the user.
    """

    error_frame: Callable[[int, bytes, int], None] = nothing
    say: Callable[[str], None] = nothing


class Port(Protocol):
    """One participant's connection to one bus. A port never receives what it sent itself."""

    @property
    def clock(self) -> Clock:
        """Clock on which this port waits and stamps."""

    @property
    def channel(self) -> str:
        """Name of the bus in messages and logs."""

    @property
    def counters(self) -> PortCounters:
        """Counters since the port was opened."""

    @property
    def state(self) -> ControllerState:
        """Error state of the CAN controller, as far as the port knows it."""

    @property
    def stamps_arrival(self) -> bool:
        """Whether a received frame carries the time of its arrival; if not, that of the `drain` that returned it."""

    @property
    def descriptor(self) -> int | None:
        """A file descriptor that can be read once `drain` has something; None where the port has none.

        Raises:
            InterfaceError: the port is closed.
        """

    def send_batch(self, frames: Sequence[Frame], t_ns: int | None = None) -> None:
        """Send `frames` in this order.

        Args:
            frames: frames to send.
            t_ns: present time, where the caller has just read it; only a port that records uses it.

        Raises:
            InterfaceError: the interface is down, closed, lost or stays full.
        """

    def send_on(self, channel: str, frames: Sequence[Frame]) -> None:
        """Send frames on the bus of a channel, whatever their identifiers, where the port is on several buses.

        Raises:
            InterfaceError: as for `send_batch`.
        """

    def drain(self) -> list[TimedFrame]:
        """Return every frame that has arrived, in order, without waiting; the next call starts empty.

        Raises:
            InterfaceError: the interface is down, closed or lost.
        """

    def wait(self, until_ns: int) -> None:
        """Return as soon as `drain` may have something, at `until_ns` at the latest.

        Raises:
            InterfaceError: the interface is down, closed or lost.
        """

    def wait_and_drain(self, until_ns: int) -> list[TimedFrame]:
        """Wait for frames, until `until_ns` at the latest, and return them.

        Raises:
            InterfaceError: the interface is down, closed or lost.
        """

    def defer(self, can_ids: Collection[int]) -> None:
        """Let frames with these 11-bit identifiers wake nobody, where the interface can; the next other brings them.

        Raises:
            InterfaceError: the port has filters, or the interface is lost.
        """

    def close(self) -> None:
        """Give the interface back. A second call is allowed; every other call afterwards raises InterfaceError."""


def stamps_text(port: Port, late_ns: int) -> str:
    """The clock that stamps the frames of a port, for people.

    Args:
        port: the port.
        late_ns: lateness of wake-ups, the largest that was seen.
    """
    if port.stamps_arrival:
        return "at their arrival, by the kernel or in virtual time"
    return f"when python-can gives them, after the adapter's delay and up to {late_ns * 1e-6:.1f} ms of this machine"


class PlainPort:
    """Base class of ports: on one bus, they wait and drain in two calls, and are woken by every frame."""

    @property
    def descriptor(self) -> int | None:
        """None, as only the port itself can wait for its frames."""
        return None

    def send_on(self: Port, channel: str, frames: Sequence[Frame]) -> None:
        """Send frames on the only bus."""
        self.send_batch(frames)

    def wait_and_drain(self: Port, until_ns: int) -> list[TimedFrame]:
        """Wait for frames, until `until_ns` at the latest, and return them."""
        self.wait(until_ns)
        return self.drain()

    def defer(self, can_ids: Collection[int]) -> None:
        """Do nothing: these frames wake the port too."""
