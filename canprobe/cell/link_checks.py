"""What is wrong with the setting of a SocketCAN interface, and the line that mends it.

Sample points: CiA 301 recommends 87.5 % of the bit (85 to 90 %). Above 500 kbit/s, where 75 to 80 % is usual, 80 %.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from canprobe.bus.link import VIRTUAL, LinkState
from canprobe.planning import Plan

SLOW_BIT_S = 500_000
SLOW_SAMPLE, FAST_SAMPLE = (0.85, 0.875, 0.90), (0.75, 0.80, 0.90)  # lowest, recommended, highest
RATE_TOLERANCE = 0.005
RESTART_MS, TX_QUEUE = 100, 1000
PASSIVE = 128
"""Error counter from which a controller is error-passive (ISO 11898-1)."""
TERMINATION = "with the bus unpowered, 60 ohm between CAN_H and CAN_L are right, 120 is one terminator missing"


@dataclass(frozen=True, slots=True)
class Remark:
    """One finding.

    Attributes:
        is_error: the cell cannot work so; else it can, but not well.
        text: what is so, what it does, and what to type.
    """

    is_error: bool
    text: str


@dataclass(frozen=True, slots=True)
class Expected:
    """What a cell wants of an interface.

    Attributes:
        bitrate, data_bitrate: bit/s; the second of CAN FD, None without.
        frames_at_once: that the master queues at one time, at most.
    """

    bitrate: int
    data_bitrate: int | None = None
    frames_at_once: int = 1


def expected_of(plan: Plan, channel: str) -> Expected:
    """What a plan wants: after a late cycle the frames of two go at once, each SYNC, heartbeat and every RPDO."""
    bus = plan.setup.bus
    rpdos = {pdo.cob_id for pdo in plan.pdos if pdo.channel == channel and pdo.direction == "rpdo"}
    return Expected(bus.bitrate, bus.data_bitrate if bus.fd is True else None, 2 * (len(rpdos) + 2))


def check_link(link: LinkState, expected: Expected) -> list[Remark]:
    """Everything that is wrong with an interface; nothing where all is well, and nothing of a virtual one."""
    if link.kind in VIRTUAL:
        return []
    checks = (_rates, _modes, _state, _sample_point, _restart, _queue)
    return [remark for check in checks for remark in check(link, expected)]


def setting(link: LinkState, expected: Expected) -> str:
    """The line that sets an interface as a cell wants it."""
    slow = expected.bitrate <= SLOW_BIT_S
    sample = (SLOW_SAMPLE if slow else FAST_SAMPLE)[1]
    fast = f" dbitrate {expected.data_bitrate} fd on" if expected.data_bitrate is not None else ""
    return (
        f"ip link set {link.name} down && ip link set {link.name} type can bitrate {expected.bitrate}"
        f" sample-point {sample:g}{fast} restart-ms {RESTART_MS} && ip link set {link.name} txqueuelen {TX_QUEUE} up"
    )


def _rates(link: LinkState, expected: Expected) -> Iterator[Remark]:
    pairs = [("bit rate", link.bitrate, expected.bitrate)]
    if expected.data_bitrate is not None:
        pairs.append(("data bit rate", link.data_bitrate, expected.data_bitrate))
    for what, have, want in pairs:
        if have is not None and abs(have - want) > RATE_TOLERANCE * want:
            yield Remark(True, f"its {what} is {have} bit/s, the scene's {want}; type: {setting(link, expected)}")


def _modes(link: LinkState, expected: Expected) -> Iterator[Remark]:
    name = link.name
    for mode, what in (("LISTEN-ONLY", "cannot send"), ("LOOPBACK", "hears only itself")):
        if mode in link.modes:
            off = f"ip link set {name} down && ip link set {name} type can {mode.lower()} off && ip link set {name} up"
            yield Remark(True, f"it is in {mode.lower()} mode and {what}; type: {off}")
    if "ONE-SHOT" in link.modes:
        yield Remark(False, "it is in one-shot mode: a frame that loses the arbitration is not sent again")


def _state(link: LinkState, _: Expected) -> Iterator[Remark]:
    counters = f"error counters: {link.tx_errors} transmit, {link.rx_errors} receive"
    if link.state == "BUS-OFF":
        yield Remark(
            True,
            f"it is bus-off ({counters}): check wiring, bit rate and termination ({TERMINATION}),"
            f" then type: ip link set {link.name} type can restart",
        )
    elif link.state in ("ERROR-PASSIVE", "ERROR-WARNING"):
        yield Remark(False, f"it is {link.state.lower()} ({counters}): {_symptom(link)}; {TERMINATION}")
    elif link.bus_offs:
        yield Remark(False, f"it was bus-off {link.bus_offs} times since it was made: look at wiring and termination")


def _symptom(link: LinkState) -> str:
    if (link.tx_errors or 0) > (link.rx_errors or 0):
        return "nobody acknowledges what it sends: nodes without power, another bit rate, a broken wire"
    return "frames arrive broken: another bit rate or sample point somewhere, or the termination"


def _sample_point(link: LinkState, expected: Expected) -> Iterator[Remark]:
    low, best, high = SLOW_SAMPLE if expected.bitrate <= SLOW_BIT_S else FAST_SAMPLE
    point = link.sample_point
    if point is not None and not low - 1e-3 <= point <= high + 1e-3:
        yield Remark(
            False,
            f"it samples at {100 * point:.1f} % of the bit, {100 * best:g} % is recommended at"
            f" {expected.bitrate} bit/s; type: {setting(link, expected)}",
        )


def _restart(link: LinkState, expected: Expected) -> Iterator[Remark]:
    if link.restart_ms == 0:
        yield Remark(
            False,
            "restart-ms is 0: after a bus-off it stays off until somebody restarts it;"
            f" type: {setting(link, expected)}",
        )


def _queue(link: LinkState, expected: Expected) -> Iterator[Remark]:
    if link.tx_queue is not None and link.tx_queue < expected.frames_at_once:
        yield Remark(
            False,
            f"its queue holds {link.tx_queue} frames, and {expected.frames_at_once} may be sent at once;"
            f" type: ip link set {link.name} txqueuelen {TX_QUEUE}",
        )
