"""What the cycle sees of a CAN bus: frames out in batches, frames in with their time, and a wait.

A frame is `(can_id, data)`. Identifiers above 11 bits and remote requests carry the flags of Linux's `struct
can_frame`: `EFF_FLAG` for a 29-bit identifier, `RTR_FLAG` for a remote request; plain data frames are the bare
identifier. Error frames are never passed on: they are counted, and a hardware port shows its controller's state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

from canprobe.bus.clock import Clock
from canprobe.protocol.frames import EFF_FLAG, RTR_FLAG, Frame

__all__ = [
    "EFF_FLAG",
    "ERR_FLAG",
    "RTR_FLAG",
    "CanFilter",
    "ControllerState",
    "Frame",
    "Port",
    "PortCounters",
    "TimedFrame",
]

ERR_FLAG = 0x20000000

TimedFrame = tuple[int, bytes, int]
"""A received frame: can_id, data, time of reception in ns on the port's clock."""

CanFilter = tuple[int, int]
"""A frame is let in if `can_id & mask == filter_id & mask` for one of the filters: (filter_id, mask)."""


class ControllerState(IntEnum):
    """Error state of the CAN controller, as far as error frames tell (ISO 11898-1 fault confinement)."""

    ACTIVE = 0
    WARNING = 1
    PASSIVE = 2
    BUS_OFF = 3


@dataclass(slots=True)
class PortCounters:
    """What a port has counted since it was opened.

    Attributes:
        sent: frames handed to the bus.
        received: data and remote frames given to the reader.
        error_frames: error frames seen and not passed on.
        overruns: frames that the kernel dropped because the reader was late.
        transmit_full: times that the transmit queue was full (ENOBUFS), retries included.
        ignored: frames that classic CAN cannot carry (CAN FD) and that were dropped.
    """

    sent: int = 0
    received: int = 0
    error_frames: int = 0
    overruns: int = 0
    transmit_full: int = 0
    ignored: int = 0


class Port(Protocol):
    """One participant's connection to one bus. A port never receives what it sent itself."""

    @property
    def clock(self) -> Clock:
        """The clock on which this port waits and stamps."""
        ...

    @property
    def channel(self) -> str:
        """The bus's name, as in messages and logs."""
        ...

    @property
    def counters(self) -> PortCounters:
        """What has passed since the port was opened."""
        ...

    @property
    def state(self) -> ControllerState:
        """The CAN controller's error state, as far as the port can tell."""
        ...

    @property
    def stamps_arrival(self) -> bool:
        """Whether a received frame carries the time of its arrival; if not, that of the `drain` that returned it."""
        ...

    def send_batch(self, frames: Sequence[Frame], t_ns: int | None = None) -> None:
        """Send `frames` in this order.

        Args:
            frames: the frames.
            t_ns: the present time, where the caller has just read it; only a port that writes down uses it.

        Raises:
            InterfaceError: the interface is down, closed, lost or stays full.
        """
        ...

    def drain(self) -> list[TimedFrame]:
        """Return every frame that has arrived, in order, without waiting; the next call starts empty.

        Raises:
            InterfaceError: the interface is down, closed or lost.
        """
        ...

    def wait(self, until_ns: int) -> None:
        """Return as soon as `drain` may have something, at `until_ns` at the latest.

        Raises:
            InterfaceError: the interface is down, closed or lost.
        """
        ...

    def close(self) -> None:
        """Give the interface back; closing twice is allowed, everything else afterwards raises InterfaceError."""
        ...
