"""Check of the SocketCAN interfaces of a cell before it is brought up: warnings and errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from canprobe.cell.session.link_faults import ExpectedLink, check_link, controller_trouble
from canprobe.errors import BusError, InterfaceError
from canprobe.fieldbus.bus.port import ControllerState, Port
from canprobe.fieldbus.bus.real.link import (
    LinkState,
    missing_ip,
    read_link,
)

SOCKETCAN = "socketcan"


def check_links(
    interface: str, channels: Mapping[str, ExpectedLink], say: Callable[[str], None], *, must: bool = True
) -> None:
    """Check SocketCAN interfaces before anything is sent; other and virtual interfaces are not checked.

    Args:
        interface: interface of all channels.
        channels: the wanted setting of each channel.
        say: called with each warning.
        must: whether an interface that cannot work is an error; else it is a warning too.

    Raises:
        InterfaceError: when an interface cannot work as it is set; with the line to type.
    """
    if interface != SOCKETCAN:
        return
    from canprobe.fieldbus.bus.real.socketcan import has_socketcan

    errors: list[str] = []
    for channel, expected in channels.items():
        link = read_link(channel)
        if link is None:
            if has_socketcan():  # else opening it fails, which says so
                say(f"{channel}: its setting is not checked: {missing_ip() or '`ip` of iproute2 does not show it'}")
        elif link.is_up:  # else opening it fails, with the line to type
            for remark in check_link(link, expected):
                if must and remark.is_error:
                    errors.append(f"{channel}: {remark.text}")
                else:
                    say(f"warning: {channel}: {remark.text}")
    if errors:
        raise InterfaceError("\n".join(errors))


def need_controllers(interface: str, ports: Mapping[str, Port], error: BaseException | None = None) -> None:
    """Check that every CAN controller can send and receive, as far as its state is known.

    Args:
        interface: interface of all ports.
        ports: ports by channel; closed ones still know their last state.
        error: error that a controller's state may explain; only a `BusError` is looked at.

    Raises:
        InterfaceError: when one is bus-off or error-passive; with what to check, the line to type, and `error`.
    """
    if error is not None and not isinstance(error, BusError):
        return

    troubles: list[str] = []
    for channel, port in ports.items():
        link = (read_link(channel) if interface == SOCKETCAN else None) or LinkState(channel)
        if link.state is None:  # a virtual one, another interface, or no `ip`: the state of the last error frame
            state = port.state
            link = replace(link, state="BUS-OFF" if state is ControllerState.BUS_OFF else f"ERROR-{state.name}")
        if (trouble := controller_trouble(link, typed=interface == SOCKETCAN)) is not None:
            troubles.append(f"{channel}: its CAN controller is {trouble}")
    if troubles:
        raise InterfaceError("; ".join([*troubles, *([str(error)] if error is not None else [])])) from error
