"""Nodes that are present: each node id gets an SDO read of 1000h, all at once; any answer counts, an abort too."""

from __future__ import annotations

from collections.abc import Iterable

from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.protocol.frames import SDO_RX_BASE, SDO_TX_BASE
from canprobe.fieldbus.protocol.sdo import pack_read

SECOND_ANSWER_S = 0.05
"""Time in which a second answer to one request shows that two devices have one node id."""
DEVICE_TYPE_REQUEST = pack_read(0x1000)
BURST_FRAMES = 8
BURST_PAUSE_S = 0.002


def answering_nodes(network: PumpedNetwork, node_ids: Iterable[int], timeout_s: float) -> tuple[int, ...]:
    """Node ids, ascending, whose SDO server answers within the time-out.

    Args:
        network: network, which is pumped meanwhile.
        node_ids: node ids to ask, 1–127.
        timeout_s: time-out after the last question.

    Raises:
        InterfaceError: the interface failed.
    """
    asked = sorted(set(node_ids))
    found: set[int] = set()

    def take(can_id: int, _data: bytes, _t_ns: int) -> None:
        found.add(can_id - SDO_TX_BASE)

    for node_id in asked:
        network.subscribe(SDO_TX_BASE + node_id, take)
    try:
        for first in range(0, len(asked), BURST_FRAMES):
            network.port.send_batch(
                [(SDO_RX_BASE + n, DEVICE_TYPE_REQUEST) for n in asked[first : first + BURST_FRAMES]]
            )
            network.pump_until(lambda: len(found) == len(asked), BURST_PAUSE_S)
        network.pump_until(lambda: len(found) == len(asked), timeout_s)
    finally:
        for node_id in asked:
            network.unsubscribe(SDO_TX_BASE + node_id, take)
    return tuple(sorted(found))
