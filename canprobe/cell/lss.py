"""Give nodes their ids over the bus: find those that have none, decide which gets which, tell them.

Source: CiA 305; canopen's LSS client does the asking.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from canopen.lss import ERROR_STORE_NOT_SUPPORTED, LssError

from canprobe.bus.network import PumpedNetwork
from canprobe.errors import BusError, NodeError
from canprobe.protocol.frames import HEARTBEAT_BASE, NmtCommand, pack_nmt
from canprobe.protocol.lss import LssAddress

BOOT_UP_S = 2.0
MOST_NODES = 127


@dataclass(frozen=True, slots=True)
class Wanted:
    """A node id and the device that is to have it; a number of 1018h that is None may be any.

    Attributes:
        node_id: 1–127.
        name: for messages, such as ``joint 3``.
        numbers: vendor id, product code, revision number, serial number.
    """

    node_id: int
    name: str
    numbers: tuple[int | None, int | None, int | None, int | None]

    def fits(self, address: LssAddress) -> bool:
        """Whether a device of this address may be that node."""
        return all(want in (None, have) for want, have in zip(self.numbers, address.numbers, strict=True))


@dataclass(frozen=True, slots=True)
class Assignment:
    """What one device is told.

    Attributes:
        address: of the device.
        node_id: that it gets.
        before: that it has; None for none.
    """

    address: LssAddress
    node_id: int
    before: int | None = None


def find_unconfigured(network: PumpedNetwork) -> list[LssAddress]:
    """Every node without an id, ascending by address; all LSS slaves are waiting afterwards.

    Raises:
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
            found.append(LssAddress(*numbers))
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


def choose_assignments(
    wanted: Iterable[Wanted],
    unconfigured: Sequence[LssAddress],
    present: dict[int, LssAddress | None],
    *,
    channel: str,
    must: bool = True,
) -> list[Assignment]:
    """Which device gets which id. Nothing is left to chance: where two devices could be meant, it is an error.

    Args:
        wanted: the ids to give.
        unconfigured: devices without an id.
        present: devices that have one; None where 1018h is not complete.
        channel: of the bus, for messages.
        must: each wanted id needs a device; False: those that nobody fits are left out.

    Raises:
        NodeError: an id is in use by another device, nobody fits, or more than one device does.
    """
    chosen: list[Assignment] = []
    for want in wanted:
        if (assignment := _choose(want, unconfigured, present, channel, must)) is not None:
            chosen.append(assignment)
    taken: dict[LssAddress, int] = {}
    for one in chosen:
        if one.address in taken:
            raise NodeError(
                one.node_id,
                f"the device {one.address} could also be node {taken[one.address]}: name it by its serial number,"
                " with --assign SERIAL=ID or the scene's serial_numbers",
            )
        taken[one.address] = one.node_id
    return chosen


def _choose(
    want: Wanted, unconfigured: Sequence[LssAddress], present: dict[int, LssAddress | None], channel: str, must: bool
) -> Assignment | None:
    holder = present.get(want.node_id)
    if want.node_id in present and (not must or (holder is not None and want.fits(holder))):
        return None
    if want.node_id in present:
        whose = f"the device {holder}" if holder is not None else "a device that does not tell its identity"
        raise NodeError(want.node_id, f"({want.name}) the id is busy: {whose} on {channel} has it")
    fits = [Assignment(address, want.node_id) for address in unconfigured if want.fits(address)]
    if want.numbers[3] is not None:  # a device named by its serial number may have another id already
        fits += [
            Assignment(address, want.node_id, before)
            for before, address in present.items()
            if address is not None and want.fits(address)
        ]
    if len(fits) > 1:
        found = ", ".join(str(one.address) for one in fits)
        raise NodeError(
            want.node_id,
            f"({want.name}) {len(fits)} devices could be meant: {found} (vendor:product:revision:serial);"
            f" name one, as in --assign {fits[0].address.serial_number:#x}={want.node_id}, or connect one at a time",
        )
    if not fits and must:
        there = ", ".join(map(str, unconfigured)) or "none"
        raise NodeError(
            want.node_id,
            f"({want.name}) no device on {channel} is {_spelled(want)}; without an id:"
            f" {there}; check its power, bit rate and whether it supports LSS",
        )
    return fits[0] if fits else None


def _spelled(want: Wanted) -> str:
    return ":".join("any" if number is None else f"{number:#x}" for number in want.numbers)


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
