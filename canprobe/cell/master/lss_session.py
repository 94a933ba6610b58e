"""An LSS session on a bus: read the ids of nodes, and give them new ones.

Source: CiA 305.
"""

from __future__ import annotations

from canprobe.cell.master.id_assignment import Assignment
from canprobe.errors import BusError, NodeError
from canprobe.fieldbus.bus.lss import Lss, LssAnswerError
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.protocol.frames import (
    HEARTBEAT_BASE,
    NmtCommand,
    pack_nmt,
)
from canprobe.fieldbus.protocol.lss import LssAddress

BOOT_UP_S = 2.0
MAX_NODES = 127


class FoundTwiceError(BusError):
    """A device that was found answers the search again and hides those of higher addresses.

    Attributes:
        found: every device that was found, that one last.
    """

    def __init__(self, channel: str, found: list[LssAddress]) -> None:
        self.found = found
        super().__init__(
            f"{channel}: the device {found[-1]} (vendor:product:revision:serial) answers the search for nodes without"
            " an id again after it was found, against CiA 305, and hides those of higher addresses: give it an id"
            f" first, as in --assign {found[-1]}=ID, or disconnect it"
        )


def find_unconfigured(network: PumpedNetwork) -> list[LssAddress]:
    """Every node without an id, ascending by address; all LSS slaves are waiting afterwards.

    Raises:
        FoundTwiceError: a device does not leave the search when it is found.
        BusError: two devices have one address, or answers do not agree.
        InterfaceError: the interface failed.
    """
    lss = Lss(network)
    lss.release()
    found: list[LssAddress] = []
    try:
        for _ in range(MAX_NODES):
            address = lss.fast_scan()  # those found stay in configuration, where they no longer answer it
            if address is None:
                return found
            if address in found:
                raise FoundTwiceError(network.port.channel, [*(one for one in found if one != address), address])
            found.append(address)
            if len(lss.inquire_node_ids()) > len(found):
                raise BusError(
                    f"{network.port.channel}: more than one node without an id has the address {found[-1]}"
                    " (vendor:product:revision:serial); connect them one at a time"
                )
        return found
    finally:
        lss.release()


def assign(network: PumpedNetwork, assignment: Assignment, *, store: bool = True) -> bool:
    """Give one device its id and see it boot with it.

    Args:
        network: pumped meanwhile.
        assignment: device and id.
        store: let the device keep the id when its power goes.

    Returns:
        Whether the device keeps it; one that cannot store answers so and is left with the id for now.

    Raises:
        NodeError: the device does not answer, refuses, or does not boot with its new id.
        InterfaceError: the interface failed.
    """
    lss, node_id, address = Lss(network), assignment.node_id, assignment.address
    booted: list[int] = []

    def take(_id: int, data: bytes, t_ns: int) -> None:
        if data == b"\0":
            booted.append(t_ns)

    network.subscribe(HEARTBEAT_BASE + node_id, take)
    try:
        lss.release()
        if not lss.select(address):
            raise LssAnswerError("no answer to switch state selective")
        lss.configure_node_id(node_id)
        kept = store and lss.store()
        lss.release()
        if assignment.before is not None:
            network.port.send_batch([pack_nmt(NmtCommand.RESET_COMMUNICATION, assignment.before)])
        if not network.pump_until(lambda: bool(booted), BOOT_UP_S):
            raise NodeError(node_id, f"the device {address} took the id but sent no boot-up within {BOOT_UP_S:g} s")
        return kept
    except LssAnswerError as error:
        lss.release()
        raise NodeError(node_id, f"the device {address} did not take the id: {error}") from error
    finally:
        network.unsubscribe(HEARTBEAT_BASE + node_id, take)
