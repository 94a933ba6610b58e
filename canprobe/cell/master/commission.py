"""The work of `canprobe scan --lss`: list the nodes, find devices without an id, give them ids, list again.

`commission` is the whole of it. Which device gets which id follows from identities; where two devices could be meant
it is an error. Source: CiA 305, by canopen's LSS client.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from canprobe.cell.master.id_assignment import Assignment, Wanted, choose_assignments
from canprobe.cell.master.lss_session import FoundTwiceError, assign, find_unconfigured
from canprobe.cell.master.scan import IDENTITY_SUBINDICES, scan_nodes
from canprobe.cell.planning.model import Plan
from canprobe.errors import BusError
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.protocol.lss import LssAddress


@dataclass(frozen=True, slots=True)
class Commissioned:
    """The result of a commissioning.

    Attributes:
        nodes: nodes with an id at the end, as `scan_nodes` returns them.
        unconfigured: devices that still have none.
        assigned: devices that got an id, and whether each keeps it when its power goes.
    """

    nodes: list[dict[str, Any]]
    unconfigured: list[LssAddress]
    assigned: list[tuple[Assignment, bool]]

    def as_document(self) -> dict[str, Any]:
        """The result as JSON has it."""
        return {
            "nodes": self.nodes,
            "unconfigured": [_numbers(address) for address in self.unconfigured],
            "assigned": [
                {"node_id": one.node_id, "before": one.before, "stored": stored, **_numbers(one.address)}
                for one, stored in self.assigned
            ],
        }


def commission(
    port: Port, wanted: Sequence[Wanted], *, must: bool, store: bool = True, timeout_s: float = 0.5
) -> Commissioned:
    """Find the nodes without an id and give those that are wanted theirs.

    Args:
        port: the bus.
        wanted: ids to give and the devices that get them; empty: only look.
        must: each of them needs its device; False: as far as there is one.
        store: let the devices keep their ids when their power goes.
        timeout_s: longest time to an SDO answer.

    Raises:
        BusError: no device without an id answers though ids are wanted, it is not clear which one is meant, or a device
            hides others from the search; nothing was changed.
        NodeError: a device did not take its id; the devices before it have theirs.
        InterfaceError: the interface failed.
    """
    nodes = scan_nodes(port, timeout_s)
    network = PumpedNetwork(port)
    try:
        unconfigured = find_unconfigured(network)
    except FoundTwiceError as error:
        if not wanted or any(want.numbers[3] is None for want in wanted):
            raise  # which others could be meant is not known
        unconfigured = error.found
    present = {int(node["node_id"]): _address(node) for node in nodes}
    chosen = choose_assignments(wanted, unconfigured, present, channel=port.channel, must=must)
    if wanted and not must:
        _check_all_placed(unconfigured, chosen, wanted, port.channel)
    assigned = [(one, assign(network, one, store=store)) for one in chosen]
    if assigned:
        nodes = scan_nodes(port, timeout_s)
    gone = {one.address for one in chosen}
    return Commissioned(nodes, [address for address in unconfigured if address not in gone], assigned)


def wanted_by(plan: Plan) -> list[Wanted]:
    """The nodes of a scene: ids, and identities from their EDS files and the scene's serial numbers."""
    return [Wanted(node.node_id, node.role, node.identity.numbers) for node in plan.nodes]


def _check_all_placed(
    unconfigured: Sequence[LssAddress], chosen: Sequence[Assignment], wanted: Sequence[Wanted], channel: str
) -> None:
    if not unconfigured and not chosen:
        raise BusError(f"no node without an id answers on {channel}; check power, bit rate and termination")
    if strangers := sorted(set(unconfigured) - {one.address for one in chosen}):
        ids = ", ".join(f"{want.node_id} ({want.name})" for want in wanted)
        raise BusError(
            f"the device {strangers[0]} (vendor:product:revision:serial) on {channel} has no id, and is not one of"
            f" the scene's missing nodes, of {ids}; name it, as in --assign"
            f" {strangers[0].serial_number:#x}=ID"
        )


def _address(node: dict[str, Any]) -> LssAddress | None:
    numbers = [node[name] for name in IDENTITY_SUBINDICES]
    return None if None in numbers else LssAddress(*numbers)


def _numbers(address: LssAddress) -> dict[str, int]:
    return dict(zip(IDENTITY_SUBINDICES, address.numbers, strict=True))
