"""From a silent bus to operational nodes: listen, reset, boot-up, identity, configuration with read-back, NMT start.

Every step has its own time-out and its own words for what failed where.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from canopen import ObjectDictionary
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canprobe.bus.network import PumpedNetwork, PumpedNode
from canprobe.cell.watch import NodeWatch
from canprobe.errors import BusError, NodeError
from canprobe.protocol.frames import NmtCommand, NmtState, pack_nmt

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
class NodeSetup:
    """What one node must be and become.

    Attributes:
        node_id: the node.
        name: for messages, such as ``joint 3``.
        eds: name of its EDS file, for messages.
        dictionary: its object dictionary, from the EDS.
        identity: expected values of 1018h by sub-index; an absent sub-index is not checked.
        writes: its configuration, in order.
    """

    node_id: int
    name: str
    eds: str
    dictionary: ObjectDictionary
    identity: dict[int, int]
    writes: tuple[Write, ...]


@dataclass(frozen=True, slots=True)
class BringUpTimes:
    """Time-outs of the steps, s."""

    listen: float = 0.25
    boot_up: float = 2.0
    second_boot_up: float = 0.05
    sdo: float = 0.5
    start: float = 1.0
    release: float = 0.1


class BringUp:
    """Brings the planned nodes up over one network.

    Args:
        network: SDO and NMT, pumped.
        watch: sees every boot-up, heartbeat and EMCY that arrives meanwhile.
        setups: the nodes.
        times: time-outs.
        say: called with each step, for the user.
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
        self._nodes: dict[int, PumpedNode] = {}

    def run(self) -> None:
        """All steps up to the NMT start.

        Raises:
            NodeError: a node is missing, is another than the EDS says, or refused a value.
            BusError: somebody else is master on this bus.
        """
        self._listen()
        self._boot()
        for setup in self._setups:
            self._identify(setup)
        for setup in self._setups:
            self._say(f"configure node {setup.node_id} ({setup.name})")
            for write in setup.writes:
                self._write(setup, write)
        self._start()

    def _listen(self) -> None:
        self._say("listen for another master")
        self._network.pump_until(lambda: bool(self._watch.foreign), self._times.listen)
        if self._watch.foreign:
            raise BusError(
                f"{self._network.port.channel}: {self._watch.foreign[0]}: another master is at work here; stop it first"
            )

    def _boot(self) -> None:
        self._say(f"reset nodes {', '.join(str(s.node_id) for s in self._setups)}")
        self._watch.forget()
        before = dict(self._watch.boot_ups)
        self._network.port.send_batch([pack_nmt(NmtCommand.RESET_NODE, s.node_id) for s in self._setups])
        booted = self._network.pump_until(
            lambda: all(self._watch.boot_ups[s.node_id] > before[s.node_id] for s in self._setups), self._times.boot_up
        )
        if not booted:
            missing = [s for s in self._setups if self._watch.boot_ups[s.node_id] == before[s.node_id]]
            others = ", ".join(f"{s.node_id} ({s.name})" for s in missing[1:])
            raise NodeError(
                missing[0].node_id,
                f"({missing[0].name}) sent no boot-up within {self._times.boot_up:g} s of its reset on"
                f" {self._network.port.channel}"
                + (f"; nor did {others}" if others else "")
                + "; check power, node id, bit rate and termination, or mark it emulated in the scene",
            )
        self._network.pump_until(lambda: False, self._times.second_boot_up)
        for setup in self._setups:
            count = self._watch.boot_ups[setup.node_id] - before[setup.node_id]
            if count > 1:
                raise NodeError(setup.node_id, f"answered its reset with {count} boot-ups: the node id is in use twice")
            self._nodes[setup.node_id] = self._network.add_node(setup.node_id, setup.dictionary)
            self._nodes[setup.node_id].sdo.RESPONSE_TIMEOUT = self._times.sdo

    def _identify(self, setup: NodeSetup) -> None:
        for subindex, expected in setup.identity.items():
            got = self._read(setup, 0x1018, subindex)
            if got != expected:
                raise NodeError(
                    setup.node_id,
                    f"({setup.name}) is not the device of {setup.eds}: 1018h:{subindex:02X}"
                    f" {IDENTITY_NAMES[subindex]} expected {expected:#x}, got {got:#x}",
                )

    def _read(self, setup: NodeSetup, index: int, subindex: int) -> int:
        variable = _variable(setup, index, subindex)
        try:
            return int(variable.decode_raw(self._nodes[setup.node_id].sdo.upload(index, subindex)))
        except (SdoAbortedError, SdoCommunicationError) as error:
            raise NodeError(
                setup.node_id, f"({setup.name}) read of {index:04X}h:{subindex:02X} failed: {error}"
            ) from error

    def _write(self, setup: NodeSetup, write: Write) -> None:
        variable = _variable(setup, write.index, write.subindex)
        where = f"{write.index:04X}h:{write.subindex:02X}"
        try:
            self._nodes[setup.node_id].sdo.download(write.index, write.subindex, variable.encode_raw(write.value))
        except (SdoAbortedError, SdoCommunicationError) as error:
            raise NodeError(
                setup.node_id, f"({setup.name}) write of {where} = {write.value:#x} failed: {error}"
            ) from error
        if write.read_back and (got := self._read(setup, write.index, write.subindex)) != write.value:
            raise NodeError(
                setup.node_id, f"({setup.name}) {where} reads back {got:#x} after {write.value:#x} was written"
            )

    def _start(self) -> None:
        self._say("start all nodes")
        self._watch.forget()
        self._network.port.send_batch([pack_nmt(NmtCommand.START, s.node_id) for s in self._setups])
        ids = [s.node_id for s in self._setups]
        if not self._network.pump_until(
            lambda: all(self._watch.states.get(i) is NmtState.OPERATIONAL for i in ids), self._times.start
        ):
            slow = next(s for s in self._setups if self._watch.states.get(s.node_id) is not NmtState.OPERATIONAL)
            state = self._watch.states.get(slow.node_id)
            raise NodeError(
                slow.node_id,
                f"({slow.name}) is not operational {self._times.start:g} s after NMT start:"
                f" {'no heartbeat' if state is None else state.name}",
            )

    def release(self) -> None:
        """Take the nodes out of operation: pre-operational, heartbeat consumers off. Every node is tried."""
        self._network.port.send_batch([pack_nmt(NmtCommand.PRE_OPERATIONAL, s.node_id) for s in self._setups])
        failures: list[NodeError] = []
        for setup in self._setups:
            if setup.node_id in self._nodes:
                self._nodes[setup.node_id].sdo.RESPONSE_TIMEOUT = self._times.release
                try:
                    self._write(setup, Write(0x1016, 1, 0))
                except NodeError as error:
                    failures.append(error)
        if failures:
            raise failures[0]


def _variable(setup: NodeSetup, index: int, subindex: int) -> Any:  # canopen has no types here
    try:
        entry: Any = setup.dictionary[index]
        return entry[subindex] if hasattr(entry, "subindices") else entry
    except KeyError:
        raise NodeError(setup.node_id, f"({setup.name}) {index:04X}h:{subindex:02X} is not in {setup.eds}") from None
