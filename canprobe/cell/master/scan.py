"""List the nodes on a bus with their identity, without knowing any of them."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canprobe.errors import ProtocolError
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.presence import SECOND_ANSWER_S, answering_nodes
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.sdo import decode_text, hold_dialogues, upload
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, SDO_TX_BASE, NmtState, unpack_heartbeat

IDENTITY_SUBINDICES = {"vendor_id": 1, "product_code": 2, "revision_number": 3, "serial_number": 4}
IDENTITY, DEVICE_NAME = 0x1018, 0x1008
MAX_NODES = 127
LISTEN_S = 1.0
"""Shortest time in which heartbeats are listened for; few devices send one less often."""
_SERIAL = IDENTITY.to_bytes(2, "little") + bytes((IDENTITY_SUBINDICES["serial_number"],))
_INITIATED, _ABORTED = 0x40, 0x80


@dataclass(slots=True)
class _Sighting:
    """The frames of a node id during a scan.

    Attributes:
        state: NMT state in its last heartbeat; None without one.
        answers: answer to each SDO request, by index and sub-index as on the wire.
    """

    state: NmtState | None = None
    answers: dict[bytes, list[bytes]] = field(default_factory=dict)

    def take_heartbeat(self, _id: int, data: bytes, _t_ns: int) -> None:
        """Keep the state; another frame on this identifier is not a heartbeat."""
        with suppress(ProtocolError):
            self.state = unpack_heartbeat(data)

    def take_answer(self, _id: int, data: bytes, _t_ns: int) -> None:
        """Keep an answer that names its entry; segments do not name one."""
        if data[:1] and data[0] & 0xE0 in (_INITIATED, _ABORTED):
            self.answers.setdefault(data[1:4], []).append(data)

    @property
    def devices(self) -> int:
        """Number of devices that answer a request; more than one share this node id, 0: no answer."""
        return max(map(len, self.answers.values()), default=0)

    @property
    def serial_numbers(self) -> list[int]:
        """Every serial number that was answered, in the order of the answers."""
        answers = [data for data in self.answers.get(_SERIAL, ()) if data[0] != _ABORTED]
        return list(dict.fromkeys(int.from_bytes(data[4:8], "little") for data in answers))


def scan_nodes(port: Port, timeout_s: float) -> list[dict[str, Any]]:
    """Every node that answers an SDO request or sends heartbeats.

    Args:
        port: the bus.
        timeout_s: longest time to an answer.

    Returns:
        By rising node id: ``node_id``; ``state`` of its heartbeat; ``devices`` that answer with this id, 0 where it
        only sends heartbeats; the numbers of 1018h and the name of 1008h; ``serial_numbers`` of all the devices. None
        stands for what was not received.

    Raises:
        InterfaceError: the interface failed.
    """
    network = PumpedNetwork(port)
    seen = {node_id: _Sighting() for node_id in range(1, MAX_NODES + 1)}
    for node_id, sighting in seen.items():
        network.subscribe(HEARTBEAT_BASE + node_id, sighting.take_heartbeat)
        network.subscribe(SDO_TX_BASE + node_id, sighting.take_answer)
    end_ns = port.clock.now_ns() + round(LISTEN_S * 1e9)
    read = {node_id: dict[str, Any]() for node_id in answering_nodes(network, seen, timeout_s)}
    hold_dialogues(network, {node_id: _identify(node) for node_id, node in read.items()}, timeout_s=timeout_s)
    rest_s = (end_ns - port.clock.now_ns()) * 1e-9
    network.pump_until(lambda: False, max(rest_s, SECOND_ANSWER_S))
    unread: dict[str, Any] = dict.fromkeys((*IDENTITY_SUBINDICES, "device_name"))
    return [
        {
            "node_id": node_id,
            "state": None if sighting.state is None else sighting.state.name,
            "devices": max(sighting.devices, int(node_id in read)),  # an answer that names nothing is one too
            **read.get(node_id, unread),
            "serial_numbers": sighting.serial_numbers,
        }
        for node_id, sighting in seen.items()
        if node_id in read or sighting.answers or sighting.state is not None
    ]


def _identify(node: dict[str, Any]) -> Generator[bytes | None, bytes, None]:
    """Read the identity of a node; each answer goes into ``node``."""
    for name, subindex in IDENTITY_SUBINDICES.items():
        data = yield from _upload(IDENTITY, subindex)
        node[name] = int.from_bytes(data, "little") if data is not None and len(data) == 4 else None  # UNSIGNED32
    data = yield from _upload(DEVICE_NAME, 0)
    node["device_name"] = None if data is None else decode_text(data)


def _upload(index: int, subindex: int) -> Generator[bytes | None, bytes, bytes | None]:
    try:
        return (yield from upload(index, subindex))
    except (SdoAbortedError, SdoCommunicationError):
        return None
