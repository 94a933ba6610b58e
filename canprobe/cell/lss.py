"""Ask nodes for their ids and tell them new ones over the bus.

Source: CiA 305; canopen's LSS client does the asking.
"""

from __future__ import annotations

from typing import Any

from canopen.lss import ERROR_STORE_NOT_SUPPORTED, LssError

from canprobe.bus.network import PumpedNetwork
from canprobe.cell.lss_choice import Assignment
from canprobe.errors import BusError, NodeError
from canprobe.protocol.frames import HEARTBEAT_BASE, NmtCommand, pack_nmt
from canprobe.protocol.lss import LssAddress

BOOT_UP_S = 2.0
MOST_NODES = 127


class FoundTwiceError(BusError):
    """A device that was found answers the search again: nobody of a higher address can be found beside it.

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
    lss = _lss(network)
    lss.send_switch_state_global(lss.WAITING_STATE)
    found: list[LssAddress] = []
    try:
        for _ in range(MOST_NODES):
            is_there, numbers = lss.fast_scan()  # those found stay in configuration, where they no longer answer it
            if not is_there or numbers is None:
                return found
            address = LssAddress(*numbers)
            if address in found:
                raise FoundTwiceError(network.port.channel, [*(one for one in found if one != address), address])
            found.append(address)
            if len(lss.inquire_node_ids()) > len(found):
                raise BusError(
                    f"{network.port.channel}: more than one node without an id has the address {found[-1]}"
                    " (vendor:product:revision:serial); connect them one at a time"
                )
        return found
    except LssError as error:
        raise BusError(f"{network.port.channel}: {error}") from error
    finally:
        lss.send_switch_state_global(lss.WAITING_STATE)


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
    lss, node_id = _lss(network), assignment.node_id
    booted: list[bytes] = []
    take = lambda can_id, data, t_s: booted.append(bytes(data)) if bytes(data) == b"\0" else None  # noqa: E731
    network.subscribe(HEARTBEAT_BASE + node_id, take)
    try:
        kept = _configure(lss, assignment, store)
        lss.send_switch_state_global(lss.WAITING_STATE)
        if assignment.before is not None:
            network.port.send_batch([pack_nmt(NmtCommand.RESET_COMMUNICATION, assignment.before)])
        if not network.pump_until(lambda: bool(booted), BOOT_UP_S):
            raise NodeError(
                node_id, f"the device {assignment.address} took the id but sent no boot-up within {BOOT_UP_S:g} s"
            )
        return kept
    except LssError as error:
        lss.send_switch_state_global(lss.WAITING_STATE)
        raise NodeError(node_id, f"the device {assignment.address} did not take the id: {error}") from error
    finally:
        network.unsubscribe(HEARTBEAT_BASE + node_id, take)


def _configure(lss: Any, assignment: Assignment, store: bool) -> bool:
    lss.send_switch_state_global(lss.WAITING_STATE)
    if not lss.send_switch_state_selective(*assignment.address.numbers):
        raise LssError("no answer to switch state selective")
    lss.configure_node_id(assignment.node_id)
    if not store:
        return False
    try:
        lss.store_configuration()
    except LssError as error:
        if str(error) != f"LSS Error: {ERROR_STORE_NOT_SUPPORTED}":
            raise LssError(f"it could not store it: {error}") from error
        return False
    return True


def _lss(network: PumpedNetwork) -> Any:  # canopen has no types here
    return network.lss
