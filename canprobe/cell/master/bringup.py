"""From a silent bus to operational nodes, step by step; `BringUp.run` is the order, the steps follow below it.

1. Listen: where another master is at work nothing is sent.
2. Reset all nodes, of drives that are homed only the communication, and wait for their boot-ups. The reset takes the
   nodes over: before it no way out sends anything, after it every way out leaves them pre-operational.
3. Identify and configure all nodes side by side, each in its own order (`BringUp._configure`): identity, what the
   device must hold by itself, the writes with read-back, and where asked for storage.
4. Start all nodes and wait for their heartbeats.

The drives are enabled afterwards, in the cycle, once each has confirmed its mode: see
`canprobe.cell.master.cell.Cell.run`.

Source: CiA 302-2 (boot-up procedure); CiA 301, objects 1010h, 1018h, 1020h, 100Ah.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from canopen.objectdictionary import ODVariable
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.configuration import TARE, TARE_COMMAND, NodeSetup, Write
from canprobe.cell.planning.operation import INTERPOLATION_TIME
from canprobe.cell.scene.hardware import BringUpSettings
from canprobe.errors import BusError, NodeError
from canprobe.fieldbus.bus.presence import DEVICE_TYPE_REQUEST, SECOND_ANSWER_S
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.sdo import (
    Dialogue,
    Dialogues,
    SdoTimeoutError,
    decode_text,
    download,
    hold_dialogues,
    read_value,
    upload,
)
from canprobe.fieldbus.protocol.emcy import describe, is_no_error
from canprobe.fieldbus.protocol.frames import SDO_RX_BASE, SDO_TX_BASE, NmtCommand, NmtState, pack_nmt

ERROR_HISTORY = 0x1003
SOFTWARE_VERSION, STORE_PARAMETERS, VERIFY_CONFIGURATION = 0x100A, 0x1010, 0x1020
SAVE_SIGNATURE = int.from_bytes(b"save", "little")
HEARTBEAT_CONSUMER = 0x1016
PDO_PARAMETERS = range(0x1400, 0x1C00)
MODE_DISPLAY = 0x6061
REVISION_SUBINDEX = 3
IDENTITY, SERIAL_SUBINDEX = 0x1018, 4
IDENTITY_NAMES = {1: "vendor id", 2: "product code", 3: "revision number", 4: "serial number"}
RELEASE_S = 0.1
"""Longest time to an answer of a node that is released."""


@dataclass(slots=True)
class NodeReport:
    """The result of bring-up for a node.

    Attributes:
        setup: configuration of the node.
        software: its version by 100Ah; None where the node does not report it.
        kept: its configuration was there already, by 1020h.
        repeated: requests that were sent again.
        remarks: accepted differences of the device from its EDS or from the wished configuration.
        failure: error of this node; None without one.
    """

    setup: NodeSetup
    software: str | None = None
    kept: bool = False
    repeated: int = 0
    remarks: list[str] = field(default_factory=list)
    failure: NodeError | None = None

    def __str__(self) -> str:
        did = "configuration kept" if self.kept else "configured"
        software = f", software {self.software}" if self.software else ""
        again = f", {self.repeated} requests repeated" if self.repeated else ""
        return f"node {self.setup.node_id}: ({self.setup.name}) {did}{software}{again}"


class BringUp:
    """Brings the planned nodes up over one network.

    Args:
        network: SDO and NMT, pumped.
        watch: sees every boot-up, heartbeat and EMCY that arrives meanwhile.
        setups: configurations of the nodes.
        settings: times, retries, and whether the nodes store their configuration.
        say: called with each step, for the user.
        listened: whether the caller has listened for another master until now.
        resets: whether the nodes are reset; else they are only made pre-operational, and keep what they hold.

    Attributes:
        took_over: the nodes were reset by this cell. Before that it must not send: another master may use them.
        released: nodes that confirmed on the way out that they watch this master no more.
    """

    def __init__(
        self,
        network: PumpedNetwork,
        watch: NodeWatch,
        setups: tuple[NodeSetup, ...],
        settings: BringUpSettings,
        say: Callable[[str], None],
        *,
        listened: bool,
        resets: bool,
    ) -> None:
        self._network = network
        self._watch = watch
        self._setups = setups
        self._settings = settings
        self._say = say
        self._booted: dict[int, int] = {}
        self._history: dict[int, str] = {}
        self._refused: set[tuple[int, int]] = set()
        self._listened = listened
        self._resets = resets
        self.took_over = False
        self.released: set[int] = set()

    def run(self) -> None:
        """All steps up to the NMT start.

        Raises:
            NodeError: nodes are missing, do not match their EDS, or refused a value; it names all of them.
            BusError: another master uses this bus.
        """
        self.listen()
        if not self._setups:
            return
        if self._resets:
            self._reset()
        else:
            self.took_over, self._booted = True, dict(self._watch.boot_ups)
            self._network.port.send_batch([pack_nmt(NmtCommand.PRE_OPERATIONAL, s.node_id) for s in self._setups])
        self._configure_all()
        self.listen()
        self._refuse_unconfigured()
        self._start()
        self._refuse_unconfigured()

    # 1. listen

    def listen(self) -> None:
        """Listen for another master: for a while the first time, afterwards only what has come since.

        Nothing is sent.

        Raises:
            BusError: another master uses this bus.
        """
        if not self._listened:
            self._say("listen for another master")
        listen_s = 0.0 if self._listened else self._settings.listen_s
        self._network.pump_until(lambda: self._watch.foreign is not None, listen_s)
        self._listened = True
        if self._watch.foreign is not None:
            raise BusError(
                f"{self._network.port.channel}: {self._watch.foreign}: another master is at work here; stop it first"
            )

    # 2. reset

    def _reset(self) -> None:
        boot_ups, missing = self._watch.boot_ups, list(self._setups)
        self._watch.forget()
        before = {setup.node_id: boot_ups[setup.node_id] for setup in missing}
        resets = dict.fromkeys(before, 0)
        self.took_over = True
        for _ in range(1 + self._settings.retries):
            self._say(f"reset nodes {', '.join(str(s.node_id) for s in missing)}")
            frames = []
            for setup in missing:  # a drive that is homed would lose its zero with the reset of the node
                reset = NmtCommand.RESET_COMMUNICATION if setup.homing else NmtCommand.RESET_NODE
                frames.append(pack_nmt(reset, setup.node_id))
                resets[setup.node_id] += 1
            self._network.port.send_batch(frames)
            self._network.pump_until(lambda: all(boot_ups[i] > before[i] for i in before), self._settings.boot_up_s)
            missing = [s for s in self._setups if boot_ups[s.node_id] == before[s.node_id]]
            if not missing:
                break
        if missing:
            raise self._error(
                f"({missing[0].name}) sent no boot-up within {self._settings.boot_up_s:g} s of its reset on"
                f" {missing[0].channel}{_others('nor did', missing)}"
                "; check power, node id, bit rate and termination, or mark it emulated in the scene",
                *missing,
            )
        self._network.pump_until(lambda: False, SECOND_ANSWER_S)
        self._booted = dict(boot_ups)
        for setup in self._setups:
            count = self._booted[setup.node_id] - before[setup.node_id]
            if count > resets[setup.node_id]:
                self._refuse_twins(setup, count)

    def _refuse_twins(self, setup: NodeSetup, boot_ups: int) -> None:
        """Refuse two nodes of one id: both answer a request. A node that boots twice, by its loader, answers once."""
        answers: list[bytes] = []
        cob_id = SDO_TX_BASE + setup.node_id

        def take(_id: int, data: bytes, _t_ns: int) -> None:
            answers.append(data)

        self._network.subscribe(cob_id, take)
        try:
            self._network.send_message(SDO_RX_BASE + setup.node_id, DEVICE_TYPE_REQUEST)
            self._network.pump_until(lambda: bool(answers), self._settings.sdo_s)
            self._network.pump_until(lambda: len(answers) > 1, SECOND_ANSWER_S)
        finally:
            self._network.unsubscribe(cob_id, take)
        if len(answers) > 1:
            raise self._error(
                f"({setup.name}) answered its reset with {boot_ups} boot-ups and a request with {len(answers)} answers:"
                " the node id is in use twice",
                setup,
            )
        self._say(f"node {setup.node_id}: ({setup.name}) sent {boot_ups} boot-ups after its reset")

    # 3. identify and configure

    def _configure_all(self) -> None:
        self._say("identify and configure the nodes")
        reports = {setup.node_id: NodeReport(setup) for setup in self._setups}
        repeated = self._talk({i: self._configure(report) for i, report in reports.items()}, self._settings.sdo_s)
        failures = []
        for node_id, report in reports.items():
            report.repeated = repeated.get(node_id, 0)
            if report.failure is not None:
                failures.append(self._error(report.failure.reason, report.setup))
        if failures:
            first, *others = failures
            raise NodeError(first.node_id, "; ".join([first.reason, *map(str, others)]))
        for report in reports.values():
            self._say(str(report))
            node = f"node {report.setup.node_id}: ({report.setup.name})"
            for remark in report.remarks:
                self._say(f"{node} {remark}")
            if left := ", ".join(dict.fromkeys(f"{one.write.index:04X}h" for one in report.setup.left_out)):
                self._say(f"{node} cannot take {left} by its EDS: left as the device has it")

    def _configure(self, report: NodeReport) -> Dialogue:
        """The whole dialogue with one node: identify, check, write, store."""
        setup = report.setup
        try:
            yield from self._identify(report)
            yield from self._check_given(setup)
            yield from self._check_units(report)
            report.kept = self._settings.store and (yield from self._is_kept(setup))
            yield from self._write_all(report)
            if self._settings.store and not report.kept:
                yield from self._keep(setup)
        except NodeError as error:
            slow = isinstance(error.__cause__, SdoTimeoutError)
            hint = "; if it is only slow, it needs a larger bring_up.sdo_s" if slow else ""
            report.failure = NodeError(setup.node_id, error.reason + hint)
            if not slow:
                yield from self._recall(setup)

    def _identify(self, report: NodeReport) -> Dialogue:
        setup = report.setup
        for subindex, expected in setup.identity.items():
            got = yield from read_entry(setup, IDENTITY, subindex)
            newer = got > expected and got >> 16 == expected >> 16  # CiA 301, 1018h:03: of the same major revision
            if subindex == REVISION_SUBINDEX and newer:
                report.remarks.append(
                    f"has revision {got:08X}h, {setup.eds} describes {expected:08X}h: the same major revision, taken"
                )
            elif got != expected:
                raise NodeError(
                    setup.node_id,
                    f"({setup.name}) is not the device of {setup.eds}: 1018h:{subindex:02X}"
                    f" {IDENTITY_NAMES[subindex]} expected {expected:#x}, got {got:#x}",
                )
        if SOFTWARE_VERSION in setup.dictionary:
            try:
                version = yield from upload(SOFTWARE_VERSION, 0)
            except (SdoAbortedError, SdoCommunicationError):
                return
            report.software = decode_text(version)

    def _check_given(self, setup: NodeSetup) -> Dialogue:
        for given in setup.given:
            got = yield from read_entry(setup, given.index, given.subindex)
            if got != given.value:
                raise NodeError(
                    setup.node_id,
                    f"({setup.name}) {given.index:04X}h:{given.subindex:02X} expected {given.value},"
                    f" {given.says}, got {got}: {given.otherwise}",
                )

    def _check_units(self, report: NodeReport) -> Dialogue:
        """Compare the units of a motor turn that the device states; what it does not answer is not compared."""
        turn = report.setup.turn
        if turn is None:
            return
        quotients = []
        for index in (turn.feed, turn.ratio):
            if index is not None:
                try:
                    over = yield from read_entry(report.setup, index, 1)
                    under = yield from read_entry(report.setup, index, 2)
                except NodeError as error:
                    if isinstance(error.__cause__, SdoAbortedError):
                        return
                    raise
                if not over or not under:
                    return
                quotients.append(over / under)
        if (mismatch := turn.mismatch(quotients[0], quotients[1] if len(quotients) > 1 else 1.0)) is not None:
            report.remarks.append(mismatch)

    def _is_kept(self, setup: NodeSetup) -> Generator[bytes | None, bytes, bool]:
        """Whether the node reports that it was configured with these very values."""
        if not _can_verify(setup):
            return False
        for subindex, expected in setup.configuration_date.items():
            if (yield from read_entry(setup, VERIFY_CONFIGURATION, subindex)) != expected:
                return False
        return True

    def _keep(self, setup: NodeSetup) -> Dialogue:
        if not _can_verify(setup):
            return
        for subindex, value in setup.configuration_date.items():
            yield from write_entry(setup, Write(VERIFY_CONFIGURATION, subindex, value, "configuration date"))
        yield from write_entry(setup, Write(STORE_PARAMETERS, 1, SAVE_SIGNATURE, "store", read_back=False))

    # 4. start

    def _start(self) -> None:
        self._watch.forget()
        waiting = list(self._setups)
        for _ in range(1 + self._settings.retries):
            all_of_them = len(waiting) == len(self._setups)
            which = "all nodes" if all_of_them else f"nodes {', '.join(str(s.node_id) for s in waiting)} again"
            self._say(f"start {which}")
            self._network.port.send_batch([pack_nmt(NmtCommand.START, s.node_id) for s in waiting])
            self._network.pump_until(lambda: not self._not_operational(), self._settings.start_s)
            if not (waiting := self._not_operational()):
                return
        self._talk({setup.node_id: self._recall(setup) for setup in waiting}, RELEASE_S)
        state = self._watch.states.get(waiting[0].node_id)
        tries = f", {1 + self._settings.retries} times" if self._settings.retries else ""
        raise self._error(
            f"({waiting[0].name}) is not operational {self._settings.start_s:g} s after NMT start{tries}:"
            f" {'no heartbeat' if state is None else state.name}{_others('nor are', waiting)}",
            *waiting,
        )

    def _not_operational(self) -> list[NodeSetup]:
        return [s for s in self._setups if self._watch.states.get(s.node_id) is not NmtState.OPERATIONAL]

    def booted_again(self) -> set[int]:
        """Nodes that have booted since their reset, by themselves or by somebody else."""
        return {node_id for node_id, count in self._booted.items() if self._watch.boot_ups[node_id] > count}

    def _refuse_unconfigured(self) -> None:
        """A node that has booted since its reset has lost its configuration, and would run with its defaults."""
        again = self.booted_again()
        for setup in self._setups:
            if setup.node_id in again:
                raise self._error(
                    f"({setup.name}) booted again after it was configured: check its power, and that no other node has"
                    " its id",
                    setup,
                )

    # in the cycle, before the drives are enabled

    def confirm_modes(self, timeout_s: float) -> Dialogues:
        """Ask every drive for the mode that it is in (6061h), until it is the planned one: to be served while cycling.

        A drive may change its mode only once it is operational and SYNC runs.

        Raises:
            NodeError: raised by the dialogues: a drive is in another mode when the time is over.
        """
        until_ns = self._network.port.clock.now_ns() + round(timeout_s * 1e9)
        asked = {s.node_id: self._confirm_mode(s, s.mode, until_ns) for s in self._setups if s.mode is not None}
        return Dialogues(self._network, asked, timeout_s=self._settings.sdo_s, retries=self._settings.retries)

    def tares(self, node_id: int) -> Dialogues:
        """Have the array tared anew: to be served while cycling."""
        write = Write(TARE_COMMAND, 0, TARE, "tare", read_back=False)
        asked = {s.node_id: write_entry(s, write) for s in self._setups if s.node_id == node_id}
        return Dialogues(self._network, asked, timeout_s=self._settings.sdo_s, retries=self._settings.retries)

    def _confirm_mode(self, setup: NodeSetup, mode: int, until_ns: int) -> Dialogue:
        while (got := (yield from read_entry(setup, MODE_DISPLAY, 0))) != mode:
            if self._network.port.clock.now_ns() >= until_ns:
                raise self._error(
                    f"({setup.name}) is in mode {got} (6061h) after 6060h = {mode} was written: it is not enabled;"
                    " it may not have this mode, or need another setting for it",
                    setup,
                )

    def serial_numbers(self, node_ids: Collection[int]) -> dict[int, int]:
        """1018h:04 of nodes, once they are up; without those that have or answer none."""
        found: dict[int, int] = {}

        def ask(setup: NodeSetup) -> Dialogue:
            with contextlib.suppress(NodeError):
                found[setup.node_id] = yield from read_entry(setup, IDENTITY, SERIAL_SUBINDEX)

        self._talk({s.node_id: ask(s) for s in self._setups if s.node_id in node_ids}, self._settings.sdo_s)
        return found

    # the way out

    def release(self) -> None:
        """Take the nodes that were taken over out of operation: pre-operational, heartbeat consumers off."""
        if not self.took_over:
            return
        self._network.port.send_batch([pack_nmt(NmtCommand.PRE_OPERATIONAL, s.node_id) for s in self._setups])
        failures: list[NodeError] = []

        def consumer_off(setup: NodeSetup) -> Dialogue:
            has_one = any(write.index == HEARTBEAT_CONSUMER for write in setup.writes)
            if setup.node_id not in self._booted or not has_one:
                return
            if (setup.node_id, HEARTBEAT_CONSUMER) in self._refused:
                return
            try:
                yield from write_entry(setup, Write(HEARTBEAT_CONSUMER, 1, 0, "the master leaves"))
                self.released.add(setup.node_id)
            except NodeError as error:
                failures.append(error)

        self._talk({setup.node_id: consumer_off(setup) for setup in self._setups}, RELEASE_S)
        if failures:
            raise failures[0]

    # parts of the steps

    def _talk(self, dialogues: Mapping[int, Dialogue], timeout_s: float) -> dict[int, int]:
        return hold_dialogues(self._network, dialogues, timeout_s=timeout_s, retries=self._settings.retries)

    def _write_all(self, report: NodeReport) -> Dialogue:
        """Write the configuration; a wish that the device refuses is left out with a remark."""
        setup = report.setup
        times = [tuple(write for write in setup.writes if write.index == INTERPOLATION_TIME), *setup.otherwise]
        for write in setup.writes:
            if report.kept and write.read_back:
                continue
            if write.index != INTERPOLATION_TIME:
                try:
                    yield from write_entry(setup, write)
                except RefusedError as refused:
                    if write.absence is None:
                        raise
                    self._refused.add((setup.node_id, write.index))
                    reason = refused.reason.removeprefix(f"({setup.name}) ")
                    report.remarks.append(f"{reason}: left as the device has it ({write.purpose}): {write.absence}")
            elif write is times[0][0]:
                yield from self._write_one_of(report, times)

    def _write_one_of(self, report: NodeReport, options: Sequence[Sequence[Write]]) -> Dialogue:
        """Write the first set that the device takes, of several sets that mean the same."""
        first: RefusedError | None = None
        for writes in options:
            try:
                for write in writes:
                    yield from write_entry(report.setup, write)
            except RefusedError as refused:
                first = first or refused
            else:
                if first is not None:
                    values = ", ".join(f"{write.place} = {write.value}" for write in writes)
                    report.remarks.append(f"takes {values}, which means the same as what it refused")
                return
        assert first is not None
        raise RefusedError(first.node_id, first.reason + (yield from _fitting_rate(report.setup, options))) from first

    def _recall(self, setup: NodeSetup) -> Dialogue:
        """Read the newest entry in the error history of a node that has failed, unless its EMCY was received."""
        if setup.node_id in self._watch.last_alarm or ERROR_HISTORY not in setup.dictionary:
            return
        try:
            newest = yield from upload(ERROR_HISTORY, 1)
        except (SdoAbortedError, SdoCommunicationError):
            return  # it is empty
        if not is_no_error(code := int.from_bytes(newest[:2], "little")):
            words = f"; its error history (1003h) begins with {code:04X}h, {describe(code)}"
            self._history[setup.node_id] = words

    def _error(self, reason: str, *setups: NodeSetup) -> NodeError:
        """The error of these nodes, with the last EMCY of each of them."""
        ids = [setup.node_id for setup in setups]
        return NodeError(ids[0], reason + "".join([self._watch.last_words(i) or self._history.get(i, "") for i in ids]))


class RefusedError(NodeError):
    """A device refused a value, or holds another one after the write."""


def read_entry(setup: NodeSetup, index: int, subindex: int) -> Generator[bytes | None, bytes, int]:
    """Read an integer of a node.

    Raises:
        NodeError: the node has no such entry, refuses, or does not answer.
    """
    variable = _variable(setup, index, subindex)
    try:
        return int((yield from read_value(variable)))
    except (SdoAbortedError, SdoCommunicationError, ValueError) as error:  # ValueError: octets are no integer
        raise NodeError(setup.node_id, f"({setup.name}) read of {index:04X}h:{subindex:02X} failed: {error}") from error


def write_entry(setup: NodeSetup, write: Write) -> Dialogue:
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


def _fitting_rate(setup: NodeSetup, options: Sequence[Sequence[Write]]) -> Generator[bytes | None, bytes, str]:
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


def _refused(setup: NodeSetup, write: Write, error: Exception, held: int | None = None) -> RefusedError:
    text = _failed(setup, write, error)
    if held is not None:
        text += f"; it holds {held:#x}"
        if write.index in PDO_PARAMETERS:
            text += ": if it is fixed, say so in the EDS (AccessType=const), and the plan takes it as it is"
    return RefusedError(setup.node_id, text)


def _failed(setup: NodeSetup, write: Write, error: Exception) -> str:
    return f"({setup.name}) write of {write.place} = {write.value:#x} failed: {error}"


def _with_own_bits(write: Write, held: int) -> int:
    """The value with the bits that are the device's as it holds them."""
    return write.value & ~write.own_bits | held & write.own_bits


def _others(words: str, setups: Sequence[NodeSetup]) -> str:
    names = ", ".join(f"{s.node_id} ({s.name})" for s in setups[1:])
    return f"; {words} {names}" if names else ""


def _can_verify(setup: NodeSetup) -> bool:
    return VERIFY_CONFIGURATION in setup.dictionary and STORE_PARAMETERS in setup.dictionary


def _variable(setup: NodeSetup, index: int, subindex: int) -> Any:  # canopen has no types here
    try:
        entry: Any = setup.dictionary[index]
        return entry if isinstance(entry, ODVariable) else entry[subindex]
    except KeyError:
        raise NodeError(setup.node_id, f"({setup.name}) {index:04X}h:{subindex:02X} is not in {setup.eds}") from None
