"""Opens a port by the name of its interface."""

from __future__ import annotations

from typing import TYPE_CHECKING

from canprobe.errors import UsageError
from canprobe.fieldbus.bus.clock import Clock
from canprobe.fieldbus.bus.port import Port, Reports
from canprobe.fieldbus.bus.real.mmsg import HAS_BATCHES
from canprobe.fieldbus.bus.real.python_can import PythonCanPort
from canprobe.fieldbus.bus.real.socketcan import SocketCanPort

if TYPE_CHECKING:
    from can import BusABC


def open_port(
    interface: str | BusABC,
    channel: str,
    bitrate: int,
    clock: Clock,
    *,
    data_bitrate: int | None = None,
    waits: bool = False,
    reports: Reports | None = None,
) -> Port:
    """Open `channel` of `interface`.

    Args:
        interface: `socketcan` for a raw socket of our own, or any of python-can's interfaces; or a bus of python-can,
            which stays open.
        channel: channel in the words of that interface, such as `can0`; for an open bus any name.
        bitrate: bit rate, bit/s; a SocketCAN interface has its own, set with `ip link`.
        clock: clock in real time.
        data_bitrate: bit rate of the data phase of CAN FD frames; None: classical frames only.
        waits: whether to wait for a full transmit queue without a limit; only SocketCAN can.
        reports: receivers of error frames and of messages for the user.

    Raises:
        UsageError: there is no interface of that name.
        InterfaceError: the interface is missing, down, or cannot be opened; the message has the line to type.
    """
    if interface == "socketcan" and HAS_BATCHES:  # else python-can's
        return SocketCanPort(channel, clock, bitrate=bitrate, data_bitrate=data_bitrate, waits=waits, reports=reports)
    if interface in ("lockstep", "direct"):
        what = "a lockstep bus lives inside one run" if interface == "lockstep" else "--bus direct has no bus"
        raise UsageError(f"{channel}: {what}; there is nothing to open")
    return PythonCanPort(interface, channel, bitrate, clock, data_bitrate=data_bitrate, reports=reports)
