"""One node in bring-up: its dialogue from identity to storage, and what became of it.

Its entries are read, and written with read-back, over SDO; every failure names the node and the entry.

Source: CiA 301, objects 1003h, 100Ah, 1010h, 1018h, 1020h.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from typing import Any

from canopen.objectdictionary import ODVariable
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.node_configuration import NodeConfiguration, Write
from canprobe.errors import NodeError
from canprobe.fieldbus.bus.sdo import Dialogue, SdoTimeoutError, decode_text, download, read_value, upload
from canprobe.fieldbus.protocol.cia402 import INTERPOLATION_TIME
from canprobe.fieldbus.protocol.emcy import describe, is_no_error
from canprobe.fieldbus.protocol.pdo import PDO_OBJECTS


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
        if write.index in PDO_OBJECTS:
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


ERROR_HISTORY = 0x1003
SOFTWARE_VERSION, STORE_PARAMETERS, VERIFY_CONFIGURATION = 0x100A, 0x1010, 0x1020
SAVE_SIGNATURE = int.from_bytes(b"save", "little")
IDENTITY, REVISION_SUBINDEX, SERIAL_SUBINDEX = 0x1018, 3, 4
IDENTITY_NAMES = {1: "vendor id", 2: "product code", 3: "revision number", 4: "serial number"}


class NodeBringUp:
    """One node in bring-up.

    Args:
        setup: configuration of the node.
        watch: what the nodes reported so far.

    Attributes:
        software: its version by 100Ah; None where the node does not report it.
        kept: its configuration was there already, by 1020h.
        repeated: requests that were sent again.
        remarks: accepted differences of the device from its EDS or from the wished configuration.
        refused: objects that the device did not take.
        failure: error of this node; None without one.
    """

    def __init__(self, setup: NodeConfiguration, watch: NodeWatch) -> None:
        self.setup = setup
        self.software: str | None = None
        self.kept = False
        self.repeated = 0
        self.remarks: list[str] = []
        self.refused: set[int] = set()
        self.failure: NodeError | None = None
        self._watch = watch
        self._history = ""

    def __str__(self) -> str:
        did = "configuration kept" if self.kept else "configured"
        software = f", software {self.software}" if self.software else ""
        again = f", {self.repeated} requests repeated" if self.repeated else ""
        return f"node {self.setup.node_id}: ({self.setup.name}) {did}{software}{again}"

    def last_words(self) -> str:
        """The node's last EMCY, else the newest entry of its error history, to be put behind an error."""
        return self._watch.last_words(self.setup.node_id) or self._history

    def configure(self, *, store: bool) -> Dialogue:
        """Identify the node, check it, write its configuration and, where it can, store it; see `failure`."""
        setup = self.setup
        store = store and VERIFY_CONFIGURATION in setup.dictionary and STORE_PARAMETERS in setup.dictionary
        try:
            yield from self._identify()
            yield from self._check_given()
            yield from self._check_units()
            self.kept = store and (yield from self._is_kept())
            yield from self._write_all()
            # the date comes last: a device clears 1020h with every other write (CiA 301), and stores it with the values
            if store and not self.kept:
                for subindex, value in setup.configuration_date.items():
                    yield from write_entry(setup, Write(VERIFY_CONFIGURATION, subindex, value, "configuration date"))
                yield from write_entry(setup, Write(STORE_PARAMETERS, 1, SAVE_SIGNATURE, "store", read_back=False))
        except NodeError as error:
            slow = isinstance(error.__cause__, SdoTimeoutError)
            hint = "; if it is only slow, it needs a larger bring_up.sdo_s" if slow else ""
            self.failure = NodeError(setup.node_id, error.reason + hint)
            if not slow:
                yield from self.recall()

    def _identify(self) -> Dialogue:
        setup = self.setup
        for subindex, expected in setup.identity.stated.items():
            got = yield from read_entry(setup, IDENTITY, subindex)
            newer = got > expected and got >> 16 == expected >> 16  # CiA 301, 1018h:03: of the same major revision
            if subindex == REVISION_SUBINDEX and newer:
                self.remarks.append(
                    f"has revision {got:08X}h, {setup.eds} describes {expected:08X}h: the same major revision, taken"
                )
            elif got != expected:
                place = f"1018h:{subindex:02X} {IDENTITY_NAMES[subindex]}"
                is_serial = subindex == SERIAL_SUBINDEX
                meant = f"; if it is meant, its serial_number is {got:#x} in the cell file" if is_serial else ""
                raise setup.error(
                    f"is not the device of {setup.eds}: {place} expected {expected:#x}, got {got:#x}{meant}"
                )
        if SOFTWARE_VERSION in setup.dictionary:
            try:
                version = yield from upload(SOFTWARE_VERSION, 0)
            except (SdoAbortedError, SdoCommunicationError):
                return
            self.software = decode_text(version)

    def _check_given(self) -> Dialogue:
        setup = self.setup
        for given in setup.given:
            got = yield from read_entry(setup, given.index, given.subindex)
            if got != given.value:
                expected = f"{given.index:04X}h:{given.subindex:02X} expected {given.value}, {given.says}"
                raise setup.error(f"{expected}, got {got}: {given.otherwise}")

    def _check_units(self) -> Dialogue:
        """Compare the units of a motor turn that the device states; what it does not answer is not compared."""
        turn = self.setup.turn
        if turn is None:
            return
        quotients = []
        for index in (turn.feed, turn.ratio):
            if index is not None:
                try:
                    over = yield from read_entry(self.setup, index, 1)
                    under = yield from read_entry(self.setup, index, 2)
                except NodeError as error:
                    if isinstance(error.__cause__, SdoAbortedError):
                        return
                    raise
                if not over or not under:
                    return
                quotients.append(over / under)
        if (mismatch := turn.mismatch(quotients[0], quotients[1] if len(quotients) > 1 else 1.0)) is not None:
            self.remarks.append(mismatch)

    def _is_kept(self) -> Generator[bytes | None, bytes, bool]:
        """Whether the node reports that it was configured with these very values."""
        for subindex, expected in self.setup.configuration_date.items():
            if (yield from read_entry(self.setup, VERIFY_CONFIGURATION, subindex)) != expected:
                return False
        return True

    def _write_all(self) -> Dialogue:
        """Write the configuration; a wish that the device refuses is left out with a remark."""
        setup = self.setup
        times = [tuple(write for write in setup.writes if write.index == INTERPOLATION_TIME), *setup.otherwise]
        for write in setup.writes:
            # what is not read back is a command, such as a tare: stored or not, it is given each time
            if self.kept and write.read_back:
                continue
            if write.index != INTERPOLATION_TIME:
                try:
                    yield from write_entry(setup, write)
                except RefusedError as refused:
                    if write.absence is None:
                        raise
                    self.refused.add(write.index)
                    reason = refused.reason.removeprefix(f"({setup.name}) ")
                    self.remarks.append(f"{reason}: left as the device has it ({write.purpose}): {write.absence}")
            elif write is times[0][0]:
                yield from self._write_one_of(times)

    def _write_one_of(self, options: Sequence[Sequence[Write]]) -> Dialogue:
        """Write the first set that the device takes, of several sets that mean the same."""
        first: RefusedError | None = None
        for writes in options:
            try:
                for write in writes:
                    yield from write_entry(self.setup, write)
            except RefusedError as refused:
                first = first or refused
            else:
                if first is not None:
                    values = ", ".join(f"{write.place} = {write.value}" for write in writes)
                    self.remarks.append(f"takes {values}, which means the same as what it refused")
                return
        assert first is not None
        raise RefusedError(first.node_id, first.reason + (yield from _fitting_rate(self.setup, options))) from first

    def recall(self) -> Dialogue:
        """Read the newest entry in the error history of a node that has failed, unless its EMCY was received."""
        setup = self.setup
        if setup.node_id in self._watch.last_alarm or ERROR_HISTORY not in setup.dictionary:
            return
        try:
            newest = yield from upload(ERROR_HISTORY, 1)
        except (SdoAbortedError, SdoCommunicationError):
            return  # it is empty
        if not is_no_error(code := int.from_bytes(newest[:2], "little")):
            self._history = f"; its error history (1003h) begins with {code:04X}h, {describe(code)}"


def _fitting_rate(setup: NodeConfiguration, options: Sequence[Sequence[Write]]) -> Generator[bytes | None, bytes, str]:
    """The rates that fit a drive which keeps its 60C2h, for the end of a message; empty where it does not answer."""
    try:
        held = yield from read_entry(setup, INTERPOLATION_TIME, 1)
        has_unit = any(write.subindex == 2 for write in options[0])
        index = (yield from read_entry(setup, INTERPOLATION_TIME, 2)) if has_unit else -3
    except NodeError:
        return ""
    unit, unit_text = 10.0**index, f"10^{index} s"
    if held not in {write.value for writes in options for write in writes if write.subindex == 1}:
        return f"; it keeps {held} · {unit_text}: cycle.rate_hz = {1 / (held * unit):.6g} fits it" if held > 0 else ""
    value, *others = options[0]  # the value was taken, its unit was not
    wanted_s = value.value * 10.0 ** (others[0].value if others else -3)
    counts = [count for count in (int(wanted_s / unit) + 1, int(wanted_s / unit)) if count]
    return f"; it counts in {unit_text}: {' or '.join(f'cycle.rate_hz = {1 / (n * unit):.6g}' for n in counts)} fits it"
