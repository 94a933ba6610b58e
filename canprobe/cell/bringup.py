"""From a silent bus to operational nodes: listen, reset, boot-up, identity, configuration with read-back, NMT start.

All nodes go through a step side by side; every step has its own time-out and its own words for what failed where.
The reset takes the nodes over: before it nothing is sent, on no way out either, and after it every way out leaves them
pre-operational.

Source: CiA 302-2 (boot-up procedure); CiA 301, objects 1010h, 1018h, 1020h, 100Ah.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from canopen import ObjectDictionary
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canprobe.bus.network import UPLOAD_DEVICE_TYPE, PumpedNetwork
from canprobe.bus.sdo_client import SdoTimeoutError, download, hold_dialogues, read_value, upload
from canprobe.cell.watch import NodeWatch
from canprobe.errors import BusError, NodeError
from canprobe.protocol.frames import NO_ERROR, SDO_RX_BASE, SDO_TX_BASE, NmtCommand, NmtState, describe, pack_nmt
from canprobe.scene.setup import BringUpTimes

ERROR_HISTORY = 0x1003
SOFTWARE_VERSION, STORE_PARAMETERS, VERIFY_CONFIGURATION = 0x100A, 0x1010, 0x1020
SAVE = int.from_bytes(b"save", "little")
HEARTBEAT_CONSUMER = 0x1016
MOST_DAYS, DAY_MS = 0xFFFF, 86_400_000
SECOND_BOOT_UP_S = 0.05
"""In which a second boot-up, or a second answer to one request, is waited for."""
RELEASE_S = 0.1
"""For one answer when the nodes are let go."""
IDENTITY_NAMES = {1: "vendor id", 2: "product code", 3: "revision number", 4: "serial number"}


@dataclass(frozen=True, slots=True)
class Write:
    """One entry to be written in bring-up and read back.

    Attributes:
        index, subindex: the entry.
        value: integer value.
        read_back: False for entries that answer something else than what was written (commands).
    """

    index: int
    subindex: int
    value: int
    read_back: bool = True


@dataclass(frozen=True, slots=True)
class Given:
    """One entry that the device cannot change and the scene relies on.

    Attributes:
        index, subindex: the entry.
        value: that it must hold.
        key: of the scene that says so.
        otherwise: what would be wrong.
    """

    index: int
    subindex: int
    value: int
    key: str
    otherwise: str


@dataclass(frozen=True, slots=True)
class NodeSetup:
    """What one node must be and become.

    Attributes:
        node_id: the node.
        name: for messages, such as ``joint 3``.
        eds: name of its EDS file, for messages.
        dictionary: its object dictionary, from the EDS.
        identity: expected values of 1018h by sub-index; an absent sub-index is not checked.
        writes: its configuration, in order.
        given: what it must hold by itself.
        lacks: objects that the cell would have set and that this make of device does not have.
    """

    node_id: int
    name: str
    eds: str
    dictionary: ObjectDictionary
    identity: dict[int, int]
    writes: tuple[Write, ...]
    given: tuple[Given, ...] = ()
    lacks: tuple[int, ...] = ()


@dataclass(slots=True)
class NodeReport:
    """How far a node came.

    Attributes:
        node_id, name: which.
        software: version as 100Ah tells it; None where it does not.
        kept: its configuration was there already, as 1020h told.
        repeated: requests that were sent again.
        failure: what went wrong; None where nothing did.
    """

    node_id: int
    name: str
    software: str | None = None
    kept: bool = False
    repeated: int = 0
    failure: NodeError | None = None

    def __str__(self) -> str:
        if self.failure is not None:
            return str(self.failure)
        did = "configuration kept" if self.kept else "configured"
        software = f", software {self.software}" if self.software else ""
        again = f", {self.repeated} requests repeated" if self.repeated else ""
        return f"node {self.node_id}: ({self.name}) {did}{software}{again}"


class BringUp:
    """Brings the planned nodes up over one network.

    Args:
        network: SDO and NMT, pumped.
        watch: sees every boot-up, heartbeat and EMCY that arrives meanwhile.
        setups: the nodes.
        times: how long the steps may take, and what is done about those that take longer.
        say: called with each step, for the user.

    Attributes:
        reports: how far each node came, in the order of the setups.
        took_over: the nodes were reset, and are ours from then on. What did not take them over must not touch them:
            another master may be at work with them.
    """

    def __init__(
        self,
        network: PumpedNetwork,
        watch: NodeWatch,
        setups: tuple[NodeSetup, ...],
        times: BringUpTimes | None = None,
        say: Callable[[str], None] = lambda _: None,
    ) -> None:
        self._network = network
        self._watch = watch
        self._setups = setups
        self._times = times or BringUpTimes()
        self._say = say
        self._booted: dict[int, int] = {}
        self._history: dict[int, str] = {}
        self._listened = False
        self.took_over = False
        self.reports = tuple(NodeReport(s.node_id, s.name) for s in setups)

    def run(self) -> None:
        """All steps up to the NMT start.

        Raises:
            NodeError: nodes are missing, are others than the EDS says, or refused a value; it names all of them.
            BusError: somebody else is master on this bus.
        """
        self.listen()
        self._boot()
        self._say("identify and configure the nodes")
        self._talk({s.node_id: self._configure(s, report) for s, report in self._pairs()}, self._times.sdo_s)
        self._raise_failures()
        for setup, report in self._pairs():
            self._say(str(report))
            if setup.lacks:
                objects = ", ".join(f"{index:04X}h" for index in setup.lacks)
                self._say(f"node {setup.node_id}: ({setup.name}) has no {objects}: left as the device has it")
        self.listen()
        self._refuse_unconfigured()
        self._start()
        self._refuse_unconfigured()

    def _pairs(self) -> Sequence[tuple[NodeSetup, NodeReport]]:
        return list(zip(self._setups, self.reports, strict=True))

    def _talk(self, dialogues: Mapping[int, Generator[bytes | None, bytes, None]], timeout_s: float) -> None:
        repeated = hold_dialogues(self._network, dialogues, timeout_s=timeout_s, retries=self._times.retries)
        for report in self.reports:
            report.repeated += repeated.get(report.node_id, 0)

    def _raise_failures(self) -> None:
        for setup, report in self._pairs():
            if report.failure is not None:
                report.failure = self._error(report.failure.reason, setup)
        failures = [report.failure for report in self.reports if report.failure is not None]
        if not failures:
            return
        first, *others = failures
        if others:
            raise NodeError(first.node_id, f"{first.reason}; " + "; ".join(map(str, others))) from first
        raise first

    def _refuse_unconfigured(self) -> None:
        """A node that has booted since its reset has lost what it was told, and would run with its defaults."""
        for setup in self._setups:
            if self._watch.boot_ups[setup.node_id] > self._booted[setup.node_id]:
                raise self._error(
                    f"({setup.name}) booted again after it was configured: check its power, and that no other node has"
                    " its id",
                    setup,
                )

    def _error(self, reason: str, *setups: NodeSetup) -> NodeError:
        """What the first of these nodes, and then the others, failed in; with the last EMCY of each of them."""
        ids = [setup.node_id for setup in setups]
        return NodeError(ids[0], reason + "".join([self._watch.last_words(i) or self._history.get(i, "") for i in ids]))

    def listen(self) -> None:
        """Hear whether somebody else is master here: for a while the first time, afterwards only what has come since.

        Nothing is sent.

        Raises:
            BusError: somebody is.
        """
        if not self._listened:
            self._say("listen for another master")
        listen_s = 0.0 if self._listened else self._times.listen_s
        self._network.pump_until(lambda: self._watch.foreign is not None, listen_s)
        self._listened = True
        if self._watch.foreign is not None:
            raise BusError(
                f"{self._network.port.channel}: {self._watch.foreign}: another master is at work here; stop it first"
            )

    def _boot(self) -> None:
        missing = list(self._setups)
        self._watch.forget()
        before = dict(self._watch.boot_ups)
        resets = dict.fromkeys(before, 0)
        self.took_over = True
        for _ in range(1 + self._times.retries):
            self._say(f"reset nodes {', '.join(str(s.node_id) for s in missing)}")
            self._network.port.send_batch([pack_nmt(NmtCommand.RESET_NODE, s.node_id) for s in missing])
            for setup in missing:
                resets[setup.node_id] += 1
            self._network.pump_until(
                lambda: all(self._watch.boot_ups[s.node_id] > before[s.node_id] for s in self._setups),
                self._times.boot_up_s,
            )
            missing = [s for s in self._setups if self._watch.boot_ups[s.node_id] == before[s.node_id]]
            if not missing:
                break
        if missing:
            self._raise_missing(missing)
        self._network.pump_until(lambda: False, SECOND_BOOT_UP_S)
        self._booted = dict(self._watch.boot_ups)
        for setup in self._setups:
            count = self._booted[setup.node_id] - before[setup.node_id]
            if count > resets[setup.node_id]:
                self._tell_apart(setup, count)

    def _tell_apart(self, setup: NodeSetup, boot_ups: int) -> None:
        """Two nodes of one id answer a request twice; one that boots twice, as by way of its loader, answers once."""
        answers: list[bytes] = []
        cob_id = SDO_TX_BASE + setup.node_id

        def take(_id: int, data: bytearray, _t_s: float) -> None:
            answers.append(bytes(data))

        self._network.subscribe(cob_id, take)
        try:
            self._network.send_message(SDO_RX_BASE + setup.node_id, UPLOAD_DEVICE_TYPE)
            self._network.pump_until(lambda: bool(answers), self._times.sdo_s)
            self._network.pump_until(lambda: len(answers) > 1, SECOND_BOOT_UP_S)
        finally:
            self._network.unsubscribe(cob_id, take)
        if len(answers) > 1:
            raise self._error(
                f"({setup.name}) answered its reset with {boot_ups} boot-ups and a request with {len(answers)} answers:"
                " the node id is in use twice",
                setup,
            )
        self._say(f"node {setup.node_id}: ({setup.name}) sent {boot_ups} boot-ups after its reset")

    def _raise_missing(self, missing: Sequence[NodeSetup]) -> None:
        others = ", ".join(f"{s.node_id} ({s.name})" for s in missing[1:])
        raise self._error(
            f"({missing[0].name}) sent no boot-up within {self._times.boot_up_s:g} s of its reset on"
            f" {self._network.port.channel}"
            + (f"; nor did {others}" if others else "")
            + "; check power, node id, bit rate and termination, or mark it emulated in the scene",
            *missing,
        )

    # what is said to one node

    def _configure(self, setup: NodeSetup, report: NodeReport) -> Generator[bytes | None, bytes, None]:
        try:
            yield from self._identify(setup, report)
            yield from self._check_given(setup)
            kept = self._times.store and (yield from self._is_kept(setup))
            report.kept = kept
            for write in setup.writes:
                if not (kept and write.read_back):
                    yield from self._write(setup, write)
            if self._times.store and not kept:
                yield from self._keep(setup)
        except NodeError as error:
            slow = isinstance(error.__cause__, SdoTimeoutError)
            hint = "; if it is only slow, it needs a larger bring_up.sdo_s" if slow else ""
            report.failure = NodeError(setup.node_id, error.reason + hint)
            if not slow:
                yield from self._recall(setup)

    def _recall(self, setup: NodeSetup) -> Generator[bytes | None, bytes, None]:
        """What a node that has failed sent before anybody listened, of which its error history tells the last."""
        if setup.node_id in self._watch.last_alarm or ERROR_HISTORY not in setup.dictionary:
            return
        try:
            newest = yield from upload(ERROR_HISTORY, 1)
        except (SdoAbortedError, SdoCommunicationError):
            return  # it is empty
        if (code := int.from_bytes(newest[:2], "little")) != NO_ERROR:
            told = f"; its error history (1003h) begins with {code:04X}h, {describe(code)}"
            self._history[setup.node_id] = told

    def _identify(self, setup: NodeSetup, report: NodeReport) -> Generator[bytes | None, bytes, None]:
        for subindex, expected in setup.identity.items():
            got = yield from self._read(setup, 0x1018, subindex)
            if got != expected:
                raise NodeError(
                    setup.node_id,
                    f"({setup.name}) is not the device of {setup.eds}: 1018h:{subindex:02X}"
                    f" {IDENTITY_NAMES[subindex]} expected {expected:#x}, got {got:#x}",
                )
        if SOFTWARE_VERSION in setup.dictionary:
            try:
                version = yield from upload(SOFTWARE_VERSION, 0)
                report.software = version.decode("latin-1").rstrip("\0")
            except (SdoAbortedError, SdoCommunicationError):
                report.software = None

    def _check_given(self, setup: NodeSetup) -> Generator[bytes | None, bytes, None]:
        for given in setup.given:
            got = yield from self._read(setup, given.index, given.subindex)
            if got != given.value:
                raise NodeError(
                    setup.node_id,
                    f"({setup.name}) {given.index:04X}h:{given.subindex:02X} expected {given.value}, as the scene's"
                    f" {given.key} says, got {got}: {given.otherwise}; put right {given.key}",
                )

    def _is_kept(self, setup: NodeSetup) -> Generator[bytes | None, bytes, bool]:
        """Whether the node says that it was configured with these very values."""
        if not _can_verify(setup):
            return False
        for subindex, expected in configuration_date(setup).items():
            if (yield from self._read(setup, VERIFY_CONFIGURATION, subindex)) != expected:
                return False
        return True

    def _keep(self, setup: NodeSetup) -> Generator[bytes | None, bytes, None]:
        if not _can_verify(setup):
            return
        for subindex, value in configuration_date(setup).items():
            yield from self._write(setup, Write(VERIFY_CONFIGURATION, subindex, value))
        yield from self._write(setup, Write(STORE_PARAMETERS, 1, SAVE, read_back=False))

    def _read(self, setup: NodeSetup, index: int, subindex: int) -> Generator[bytes | None, bytes, int]:
        variable = _variable(setup, index, subindex)
        try:
            return int((yield from read_value(variable)))
        except (SdoAbortedError, SdoCommunicationError) as error:
            raise NodeError(
                setup.node_id, f"({setup.name}) read of {index:04X}h:{subindex:02X} failed: {error}"
            ) from error

    def _write(self, setup: NodeSetup, write: Write) -> Generator[bytes | None, bytes, None]:
        variable = _variable(setup, write.index, write.subindex)
        where = f"{write.index:04X}h:{write.subindex:02X}"
        try:
            yield from download(write.index, write.subindex, variable.encode_raw(write.value))
        except (SdoAbortedError, SdoCommunicationError) as error:
            raise NodeError(
                setup.node_id, f"({setup.name}) write of {where} = {write.value:#x} failed: {error}"
            ) from error
        if not write.read_back:
            return
        got = yield from self._read(setup, write.index, write.subindex)
        if got != write.value:
            raise NodeError(
                setup.node_id, f"({setup.name}) {where} reads back {got:#x} after {write.value:#x} was written"
            )

    def _start(self) -> None:
        self._watch.forget()
        waiting = list(self._setups)
        for _ in range(1 + self._times.retries):
            all_of_them = len(waiting) == len(self._setups)
            which = "all nodes" if all_of_them else f"nodes {', '.join(str(s.node_id) for s in waiting)} again"
            self._say(f"start {which}")
            self._network.port.send_batch([pack_nmt(NmtCommand.START, s.node_id) for s in waiting])
            self._network.pump_until(lambda: not self._not_operational(), self._times.start_s)
            if not (waiting := self._not_operational()):
                return
        self._raise_not_operational(waiting)

    def _not_operational(self) -> list[NodeSetup]:
        return [s for s in self._setups if self._watch.states.get(s.node_id) is not NmtState.OPERATIONAL]

    def _raise_not_operational(self, waiting: Sequence[NodeSetup]) -> None:
        self._talk({setup.node_id: self._recall(setup) for setup in waiting}, RELEASE_S)
        slow, *others = waiting
        state = self._watch.states.get(slow.node_id)
        tries = f", {1 + self._times.retries} times" if self._times.retries else ""
        raise self._error(
            f"({slow.name}) is not operational {self._times.start_s:g} s after NMT start{tries}:"
            f" {'no heartbeat' if state is None else state.name}"
            + (f"; nor are {', '.join(f'{s.node_id} ({s.name})' for s in others)}" if others else ""),
            *waiting,
        )

    def release(self) -> None:
        """Take the nodes that are ours out of operation: pre-operational, heartbeat consumers off; each is tried."""
        if not self.took_over:
            return
        self._network.port.send_batch([pack_nmt(NmtCommand.PRE_OPERATIONAL, s.node_id) for s in self._setups])
        failures: list[NodeError] = []

        def let_go(setup: NodeSetup) -> Generator[bytes | None, bytes, None]:
            if setup.node_id not in self._booted or HEARTBEAT_CONSUMER not in setup.dictionary:
                return
            try:
                yield from self._write(setup, Write(HEARTBEAT_CONSUMER, 1, 0))
            except NodeError as error:
                failures.append(error)

        self._talk({setup.node_id: let_go(setup) for setup in self._setups}, RELEASE_S)
        if failures:
            raise failures[0]


def configuration_date(setup: NodeSetup) -> dict[int, int]:
    """What 1020h holds where a node has the configuration of ``setup``: days since 1984, milliseconds after midnight.

    They follow from the values, so that any change of them, of the EDS or of the scene, asks for another date.
    """
    text = repr((setup.eds, setup.identity, [w for w in setup.writes if w.read_back])).encode()
    return {1: 1 + zlib.crc32(text) % MOST_DAYS, 2: 1 + zlib.adler32(text) % DAY_MS}


def _can_verify(setup: NodeSetup) -> bool:
    return VERIFY_CONFIGURATION in setup.dictionary and STORE_PARAMETERS in setup.dictionary


def _variable(setup: NodeSetup, index: int, subindex: int) -> Any:  # canopen has no types here
    try:
        entry: Any = setup.dictionary[index]
        return entry[subindex] if hasattr(entry, "subindices") else entry
    except KeyError:
        raise NodeError(setup.node_id, f"({setup.name}) {index:04X}h:{subindex:02X} is not in {setup.eds}") from None
