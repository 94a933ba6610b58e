"""The work of `canprobe scan`: list the nodes with their identity, without knowing any of them.

With `--lss`, `commission`: list them, find devices without an id, give them ids, list again. Which device gets which id
follows from identities; where two devices could be meant it is an error. Source: CiA 305.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canprobe.cell.planning.model import Plan
from canprobe.errors import BusError, NodeError, ProtocolError
from canprobe.fieldbus.bus.lss import Lss, LssAnswerError
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.presence import SECOND_ANSWER_S, answering_nodes
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.sdo import decode_text, hold_dialogues, upload
from canprobe.fieldbus.protocol import frames
from canprobe.fieldbus.protocol.lss import LssAddress

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

    state: frames.NmtState | None = None
    answers: dict[bytes, list[bytes]] = field(default_factory=dict)

    def take_heartbeat(self, _id: int, data: bytes, _t_ns: int) -> None:
        """Keep the state; another frame on this identifier is not a heartbeat."""
        with suppress(ProtocolError):
            self.state = frames.unpack_heartbeat(data)

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
        network.subscribe(frames.HEARTBEAT_BASE + node_id, sighting.take_heartbeat)
        network.subscribe(frames.SDO_TX_BASE + node_id, sighting.take_answer)
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


@dataclass(frozen=True, slots=True)
class Wanted:
    """A node id and the identity of the device that is to have it; a number that is None matches any.

    Attributes:
        node_id: 1–127.
        name: name in messages, such as ``joint 3``.
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
    """The device with this address gets `node_id`; `before` is the id that it has, None for none."""

    address: LssAddress
    node_id: int
    before: int | None = None


def choose_assignments(
    wanted: Iterable[Wanted],
    unconfigured: Sequence[LssAddress],
    present: dict[int, LssAddress | None],
    *,
    channel: str,
    must: bool = True,
) -> list[Assignment]:
    """Choose the device of each node id.

    Args:
        wanted: the ids to give.
        unconfigured: devices without an id.
        present: devices that have one; None where 1018h is not complete.
        channel: channel of the bus, as messages name it.
        must: each wanted id needs a device; False: ids that no device fits are left out.

    Raises:
        NodeError: an id is in use by another device, no device fits, or more than one does.
    """
    choices = [_choose(want, unconfigured, present, channel, must) for want in wanted]
    chosen = [assignment for assignment in choices if assignment is not None]
    taken: dict[LssAddress, int] = {}
    for one in chosen:
        if one.address in taken:
            raise NodeError(
                one.node_id,
                f"the device {one.address} could also be node {taken[one.address]}: name it by its serial number,"
                " with --assign SERIAL=ID or the joints' serial_number in the scene",
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
        whose = f"the device {holder}" if holder is not None else "a device without a complete identity (1018h)"
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
        identity = ":".join("any" if number is None else f"{number:#x}" for number in want.numbers)
        raise NodeError(
            want.node_id,
            f"({want.name}) no device on {channel} is {identity}; without an id:"
            f" {there}; check its power, bit rate and whether it supports LSS",
        )
    return fits[0] if fits else None


BOOT_UP_S = 2.0


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
            # all that were found answer, each once: one answer more is of a second device, found by the same address
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

    network.subscribe(frames.HEARTBEAT_BASE + node_id, take)
    try:
        lss.release()
        if not lss.select(address):
            raise LssAnswerError("no answer to switch state selective")
        lss.configure_node_id(node_id)
        kept = store and lss.store()
        lss.release()
        # a device without an id boots by itself when it is released (CiA 305); one with an id keeps it until a reset
        if assignment.before is not None:
            network.port.send_batch([frames.pack_nmt(frames.NmtCommand.RESET_COMMUNICATION, assignment.before)])
        if not network.pump_until(lambda: bool(booted), BOOT_UP_S):
            raise NodeError(node_id, f"the device {address} took the id but sent no boot-up within {BOOT_UP_S:g} s")
        return kept
    except LssAnswerError as error:
        lss.release()
        raise NodeError(node_id, f"the device {address} did not take the id: {error}") from error
    finally:
        network.unsubscribe(frames.HEARTBEAT_BASE + node_id, take)


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
    return [Wanted(node.node_id, node.name, node.identity.numbers) for node in plan.nodes]


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
