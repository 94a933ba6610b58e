"""The check of a cell's SocketCAN interfaces before it is brought up: warnings are said, an error ends it."""

from __future__ import annotations

from collections.abc import Callable

from canprobe.errors import InterfaceError
from canprobe.planning import Plan


def check_links(plan: Plan, say: Callable[[str], None]) -> None:
    """Check every SocketCAN interface of a plan.

    Args:
        plan: of the cell.
        say: called with each warning.

    Raises:
        InterfaceError: an interface is set so that the cell cannot work; with the line to type.
    """
    if plan.scene.bus.interface != "socketcan":
        return
    from canprobe.bus.link import VIRTUAL, read_link
    from canprobe.cell.link_checks import check_link, expected_of

    errors: list[str] = []
    for bus in plan.buses:
        link = read_link(bus.channel)
        if link is None:
            say(f"{bus.channel}: its setting is not checked: `ip` of iproute2 does not tell it")
        elif link.kind in VIRTUAL:
            say(f"{bus.channel}: virtual, without a bit rate")
        elif link.is_up:  # else it cannot be opened either, which is told with the line to type
            remarks = check_link(link, expected_of(plan, bus.channel))
            errors += [f"{bus.channel}: {remark.text}" for remark in remarks if remark.is_error]
            for remark in remarks:
                if not remark.is_error:
                    say(f"warning: {bus.channel}: {remark.text}")
    if errors:
        raise InterfaceError("\n".join(errors))
