"""How the SocketCAN interfaces of a cell are set, before it is brought up: warnings and errors."""

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
    """Check SocketCAN interfaces before anything is sent; of others, and of virtual ones, there is nothing to check.

    Args:
        interface: of all channels.
        channels: and what is wanted of each.
        say: called with each warning.
        must: an interface that cannot work ends it; else that is a warning too.

    Raises:
        InterfaceError: an interface is set so that nothing can work; with the line to type.
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
    """Return where every CAN controller can send and hear, as far as is known.

    Args:
        interface: of all ports.
        ports: by channel; closed ones still know their last state.
        error: what went wrong on the bus, which a controller's state may explain; anything else is no matter of it.

    Raises:
        InterfaceError: a controller is bus-off or error-passive; with what to look at, the line to type, and `error`.
    """
    if error is not None and not isinstance(error, BusError):
        return

    troubles: list[str] = []
    for channel, port in ports.items():
        link = (read_link(channel) if interface == SOCKETCAN else None) or LinkState(channel)
        if link.state is None:  # a virtual one, another interface, or no `ip`: as of the last error frame
            state = port.state
            link = replace(link, state="BUS-OFF" if state is ControllerState.BUS_OFF else f"ERROR-{state.name}")
        if (trouble := controller_trouble(link, typed=interface == SOCKETCAN)) is not None:
            troubles.append(f"{channel}: its CAN controller is {trouble}")
    if troubles:
        raise InterfaceError("; ".join([*troubles, *([str(error)] if error is not None else [])])) from error
