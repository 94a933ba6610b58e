"""Check of the SocketCAN interfaces of a cell: faults in their settings and in their controllers, and what to type."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from canprobe.errors import BusError, InterfaceError
from canprobe.fieldbus.bus.port import ControllerState, Port
from canprobe.fieldbus.bus.real.adapters import SOCKETCAN
from canprobe.fieldbus.bus.real.link import (
    TX_QUEUE_FRAMES,
    VIRTUAL_KINDS,
    LinkState,
    emptying_line,
    ip_line,
    missing_ip,
    read_link,
    sample_points,
    setting_line,
)

if TYPE_CHECKING:  # a command for one device needs none of a cell
    from canprobe.cell.planning.model import Plan
    from canprobe.cell.scene.hardware import BusSettings

RATE_TOLERANCE = 0.005
TERMINATION = "with the bus unpowered, 60 ohm between CAN_H and CAN_L are right, 120 is one terminator missing"


@dataclass(frozen=True, slots=True)
class Remark:
    """One finding about an interface.

    Attributes:
        is_error: whether the cell cannot work with it; else it works badly.
        text: the finding, its effect, and what to type.
    """

    is_error: bool
    text: str


@dataclass(frozen=True, slots=True)
class ExpectedLink:
    """Wanted setting of an interface.

    Attributes:
        bitrate, data_bitrate: bit rates, bit/s; the second for CAN FD, None without.
        frames_at_once: most frames that are queued at one time; 0: nothing is sent.
        of_scene: whether a scene wants it; else the caller does.
    """

    bitrate: int
    data_bitrate: int | None = None
    frames_at_once: int = 1
    of_scene: bool = True


def data_bitrate(bus: BusSettings) -> int | None:
    """Bit rate of the data phase of CAN FD frames; None where only classical frames are sent."""
    return bus.data_bitrate if bus.fd is True else None


def expected_of(plan: Plan) -> dict[str, ExpectedLink]:
    """Wanted setting of each channel of a plan.

    After a late cycle the frames of two cycles are queued at once: SYNC, heartbeat and every RPDO of each.
    """
    bus = plan.setup.bus
    rpdos = {(pdo.channel, pdo.cob_id) for pdo in plan.pdos if pdo.direction == "rpdo"}
    numbers = {one.channel: sum(channel == one.channel for channel, _ in rpdos) for one in plan.buses}
    return {
        channel: ExpectedLink(bus.bitrate, data_bitrate(bus), 2 * (number + 2)) for channel, number in numbers.items()
    }


def controller_trouble(link: LinkState, *, typed: bool = True) -> str | None:
    """Why a controller cannot send or receive, and what to do; None where its state is no reason.

    Args:
        link: the interface with its state.
        typed: whether `ip` can set it.
    """
    known = link.tx_errors is not None or link.rx_errors is not None
    counters = f" (error counters: {link.tx_errors} transmit, {link.rx_errors} receive)" if known else ""
    if link.state == "BUS-OFF":
        look = f"check wiring, bit rate and termination ({TERMINATION})"
        line = f"then type: {ip_line(f'{link.name} type can restart')}"
        if link.restart_ms:
            line = f"it restarts by itself every {link.restart_ms} ms"
    elif link.state == "ERROR-PASSIVE":
        look, line = f"{_symptom(link)}; {TERMINATION}", f"then type: {emptying_line(link.name)}"
    else:
        return None
    return f"{link.state.lower()}{counters}: {look}" + (f"; {line}" if typed else "")


def check_link(link: LinkState, expected: ExpectedLink) -> Iterator[Remark]:
    """All findings about an interface; none for a virtual one."""
    if link.kind in VIRTUAL_KINDS:
        return
    name, line = link.name, setting_line(link.name, expected.bitrate, expected.data_bitrate)
    pairs = [("bit rate", link.bitrate, expected.bitrate)]
    if expected.data_bitrate is not None:
        pairs.append(("data bit rate", link.data_bitrate, expected.data_bitrate))
    for what, have, want in pairs:
        if have is not None and abs(have - want) > RATE_TOLERANCE * want:
            whose = "the scene's" if expected.of_scene else "the one asked for"
            yield Remark(True, f"its {what} is {have} bit/s, {whose} {want}; type: {line}")
    for mode, what in (("LISTEN-ONLY", "cannot send"), ("LOOPBACK", "hears only itself")):
        if mode in link.modes and expected.frames_at_once:
            off = ip_line(f"{name} down", f"{name} type can {mode.lower()} off", f"{name} up")
            yield Remark(True, f"it is in {mode.lower()} mode and {what}; type: {off}")
    if "ONE-SHOT" in link.modes:
        yield Remark(False, "it is in one-shot mode: a frame that loses the arbitration is not sent again")
    yield from _state(link)
    low, best, high = sample_points(expected.bitrate)
    point = link.sample_point
    if point is not None and not low - 1e-3 <= point <= high + 1e-3:
        at = f"{100 * point:.1f} % of the bit, {100 * best:g} % is recommended at {expected.bitrate} bit/s"
        yield Remark(False, f"it samples at {at}; type: {line}")
    if link.restart_ms == 0 and expected.frames_at_once:
        stays = "after a bus-off it stays off until somebody restarts it"
        yield Remark(False, f"restart-ms is 0: {stays}; type: {line}")
    if link.tx_queue is not None and link.tx_queue < expected.frames_at_once:
        holds = f"its queue holds {link.tx_queue} frames, and {expected.frames_at_once} may be sent at once"
        yield Remark(False, f"{holds}; type: {ip_line(f'{name} txqueuelen {TX_QUEUE_FRAMES}')}")


def _state(link: LinkState) -> Iterator[Remark]:
    if (trouble := controller_trouble(link)) is not None:
        yield Remark(link.state == "BUS-OFF", f"it is {trouble}")
    elif link.state == "ERROR-WARNING":
        counters = f"error counters: {link.tx_errors} transmit, {link.rx_errors} receive"
        yield Remark(False, f"it is error-warning ({counters}): {_symptom(link)}; {TERMINATION}")
    elif link.bus_offs:
        times = "once" if link.bus_offs == 1 else f"{link.bus_offs} times"
        yield Remark(False, f"it was bus-off {times} since it was made: look at wiring and termination")


def _symptom(link: LinkState) -> str:
    """Probable cause by the error counters; a driver without them leaves both causes open."""
    sent, heard = link.tx_errors or 0, link.rx_errors or 0
    unheard = "nobody acknowledges what it sends: nodes without power, another bit rate, a broken wire"
    broken = "frames arrive broken: another bit rate or sample point somewhere, or the termination"
    if sent == heard:
        return f"{unheard}; or {broken}"
    return unheard if sent > heard else broken


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
