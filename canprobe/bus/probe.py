"""Who is there? One SDO read of 1000h to each node id, all at once; any answer counts, an abort too."""

from __future__ import annotations

from collections.abc import Iterable

from canprobe.bus.port import Port
from canprobe.protocol.frames import SDO_RX_BASE, SDO_TX_BASE

UPLOAD_DEVICE_TYPE = bytes((0x40, 0x00, 0x10, 0x00, 0, 0, 0, 0))
BURST = 8
BURST_PAUSE_NS = 2_000_000


def answering_nodes(port: Port, node_ids: Iterable[int], timeout_s: float) -> tuple[int, ...]:
    """Node ids, ascending, whose SDO server answers within the time-out. Every other frame that arrives is dropped.

    Args:
        port: the bus.
        node_ids: whom to ask, 1–127.
        timeout_s: after the last question.

    Raises:
        InterfaceError: the interface failed.
    """
    asked = sorted(set(node_ids))
    found: set[int] = set()
    for first in range(0, len(asked), BURST):
        port.send_batch([(SDO_RX_BASE + n, UPLOAD_DEVICE_TYPE) for n in asked[first : first + BURST]])
        _listen(port, asked, found, port.clock.now_ns() + BURST_PAUSE_NS)
    _listen(port, asked, found, port.clock.now_ns() + round(timeout_s * 1e9))
    return tuple(sorted(found))


def _listen(port: Port, asked: list[int], found: set[int], until_ns: int) -> None:
    while len(found) < len(asked) and port.clock.now_ns() < until_ns:
        port.wait(until_ns)
        found.update(can_id - SDO_TX_BASE for can_id, _, _ in port.drain() if can_id - SDO_TX_BASE in asked)
