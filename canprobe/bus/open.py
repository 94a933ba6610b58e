"""Open a CAN interface by name."""

from __future__ import annotations

from collections.abc import Sequence

from canprobe.bus.clock import Clock
from canprobe.bus.port import CanFilter, Port, Reports
from canprobe.errors import UsageError


def open_port(
    interface: str,
    channel: str,
    bitrate: int,
    clock: Clock,
    *,
    filters: Sequence[CanFilter] | None = None,
    data_bitrate: int | None = None,
    waits: bool = False,
    reports: Reports | None = None,
) -> Port:
    """Open `channel` of `interface`.

    Args:
        interface: `socketcan` for a raw socket of our own, or any of python-can's interfaces.
        channel: the channel as that interface names it, such as `can0`.
        bitrate: in bit/s; a SocketCAN interface has its own, set with `ip link`.
        clock: a clock in real time.
        filters: what is let in; everything by default.
        data_bitrate: of the data phase of CAN FD frames; None: classical frames only.
        waits: wait for a full transmit queue as long as it takes; only SocketCAN can.
        reports: who hears of error frames, and of what the user has to know.

    Raises:
        UsageError: there is no interface of that name.
        InterfaceError: it is missing, down, or cannot be opened; with what to do.
    """
    if interface == "socketcan":
        from canprobe.bus.socketcan import SocketCanPort

        return SocketCanPort(
            channel, clock, filters=filters, bitrate=bitrate, data_bitrate=data_bitrate, waits=waits, reports=reports
        )
    if interface == "lockstep":
        raise UsageError(f"{channel}: a lockstep bus lives inside one run; there is nothing to open")
    from canprobe.bus.pythoncan import PythonCanPort

    return PythonCanPort(
        interface, channel, bitrate, clock, filters=filters, data_bitrate=data_bitrate, reports=reports
    )
