"""Entries of a node over SDO: read, and written with read-back; every failure names the node and the entry."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

from canopen.objectdictionary import ODVariable
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canprobe.cell.planning.node_configuration import NodeConfiguration, Write
from canprobe.errors import NodeError
from canprobe.fieldbus.bus.sdo import Dialogue, download, read_value

PDO_PARAMETERS = range(0x1400, 0x1C00)


class RefusedError(NodeError):
    """A device refused a value, or holds another one after the write."""


def read_entry(setup: NodeConfiguration, index: int, subindex: int) -> Generator[bytes | None, bytes, int]:
    """Read an integer of a node.

    Raises:
        NodeError: the node has no such entry, refuses, or does not answer.
    """
    variable = _variable(setup, index, subindex)
    try:
        return int((yield from read_value(variable)))
    except (SdoAbortedError, SdoCommunicationError, ValueError) as error:  # ValueError: octets are no integer
        raise setup.error(f"read of {index:04X}h:{subindex:02X} failed: {error}") from error


def write_entry(setup: NodeConfiguration, write: Write) -> Dialogue:
    """Write a value and read it back; a refused value counts as written where the device holds it already.

    Raises:
        RefusedError: the device refuses it, or holds another one.
        NodeError: the device does not answer.
    """
    variable = _variable(setup, write.index, write.subindex)
    value = write.value
    try:
        yield from download(write.index, write.subindex, variable.encode_raw(value))
    except SdoAbortedError as error:
        try:
            held = int((yield from read_value(variable)))
        except (SdoAbortedError, SdoCommunicationError):
            raise _refused(setup, write, error) from error
        value = _with_own_bits(write, held)
        if held == value and write.read_back:
            return
        if value == write.value:
            raise _refused(setup, write, error, held) from error
        try:
            yield from download(write.index, write.subindex, variable.encode_raw(value))
        except SdoAbortedError as again:
            raise _refused(setup, write, again, held) from again
    except SdoCommunicationError as error:
        raise NodeError(setup.node_id, _failed(setup, write, error)) from error
    if not write.read_back:
        return
    got = yield from read_entry(setup, write.index, write.subindex)
    if got not in (value, _with_own_bits(write, got)):
        raise RefusedError(
            setup.node_id, f"({setup.name}) {write.place} reads back {got:#x} after {write.value:#x} was written"
        )


def _refused(setup: NodeConfiguration, write: Write, error: Exception, held: int | None = None) -> RefusedError:
    text = _failed(setup, write, error)
    if held is not None:
        text += f"; it holds {held:#x}"
        if write.index in PDO_PARAMETERS:
            text += ": if it is fixed, say so in the EDS (AccessType=const), and the plan takes it as it is"
    return RefusedError(setup.node_id, text)


def _failed(setup: NodeConfiguration, write: Write, error: Exception) -> str:
    return f"({setup.name}) write of {write.place} = {write.value:#x} failed: {error}"


def _with_own_bits(write: Write, held: int) -> int:
    """The value with the bits that are the device's as it holds them."""
    return write.value & ~write.own_bits | held & write.own_bits


def _variable(setup: NodeConfiguration, index: int, subindex: int) -> Any:  # canopen has no types here
    try:
        entry: Any = setup.dictionary[index]
        return entry if isinstance(entry, ODVariable) else entry[subindex]
    except KeyError:
        raise setup.error(f"{index:04X}h:{subindex:02X} is not in {setup.eds}") from None
