"""List the nodes on a bus with their identity, without knowing any of them."""

from __future__ import annotations

from typing import Any

from canopen import ObjectDictionary
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canprobe.bus.network import PumpedNetwork, PumpedNode
from canprobe.bus.port import Port
from canprobe.bus.probe import answering_nodes

NUMBERS = {"vendor_id": 1, "product_code": 2, "revision_number": 3, "serial_number": 4}


def scan_nodes(port: Port, timeout_s: float) -> list[dict[str, Any]]:
    """Every node whose SDO server answers: ``node_id``, the numbers of 1018h and the name of 1008h, None where absent.

    Args:
        port: the bus.
        timeout_s: to wait for an answer.

    Raises:
        InterfaceError: the interface failed.
    """
    network = PumpedNetwork(port)
    nodes = []
    for node_id in answering_nodes(port, range(1, 128), timeout_s):
        node = network.add_node(node_id, ObjectDictionary())  # type: ignore[no-untyped-call]
        node.sdo.RESPONSE_TIMEOUT = timeout_s
        numbers = {name: _number(node, subindex) for name, subindex in NUMBERS.items()}
        nodes.append({"node_id": node_id, **numbers, "device_name": _name(node)})
    return nodes


def _upload(node: PumpedNode, index: int, subindex: int) -> bytes | None:
    try:
        return bytes(node.sdo.upload(index, subindex))
    except (SdoAbortedError, SdoCommunicationError):
        return None


def _number(node: PumpedNode, subindex: int) -> int | None:
    data = _upload(node, 0x1018, subindex)
    return None if data is None else int.from_bytes(data[:4], "little")


def _name(node: PumpedNode) -> str | None:
    data = _upload(node, 0x1008, 0)
    return None if data is None else data.decode("ascii", errors="replace").rstrip("\0")
