"""Assignment of node ids to devices by their identities."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from canprobe.errors import NodeError
from canprobe.fieldbus.protocol.lss import LssAddress


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
