"""From a silent bus to operational nodes, step by step; `BringUp.run` is the order, the steps follow below it.

1. Listen: where another master is at work nothing is sent.
2. Reset all nodes, of drives that are homed only the communication, and wait for their boot-ups. The reset takes the
   nodes over: before it no way out sends anything, after it every way out leaves them pre-operational.
3. Identify and configure all nodes side by side, each in its own order (`NodeBringUp.configure`): identity, what the
   device must hold by itself, the writes with read-back, and where asked for storage.
4. Start all nodes and wait for their heartbeats.

The drives are enabled afterwards, in the cycle, once each has confirmed its mode: see `canprobe.cell.master.arm_power`.

`FoundNodes` are the nodes as a check found them: their NMT state and what bring-up writes in them, read before and put
back after. A node that is not reset keeps the rest: its zero, and what another tool has set up. An entry that it did
not give, or does not take back, is named.

Source: CiA 302-2 (boot-up procedure).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canprobe.cell.master.node_bringup import IDENTITY, SERIAL_SUBINDEX, NodeBringUp, read_entry, write_entry
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.configuration import TARE, TARE_COMMAND
from canprobe.cell.planning.node_configuration import NodeConfiguration, Write
from canprobe.cell.scene.hardware import BringUpSettings
from canprobe.errors import BusError, NodeError
from canprobe.fieldbus.bus.presence import DEVICE_TYPE_REQUEST, SECOND_ANSWER_S
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.sdo import Dialogue, Dialogues, SdoTimeoutError, hold_dialogues
from canprobe.fieldbus.protocol.cia402 import MODE_DISPLAY, POWERED_STATES, STATUSWORD, state_of
from canprobe.fieldbus.protocol.frames import SDO_RX_BASE, SDO_TX_BASE, NmtCommand, NmtState, pack_nmt

HEARTBEAT_CONSUMER = 0x1016
RELEASE_S = 0.1
"""Longest time to an answer of a node that is released."""


@dataclass(frozen=True, slots=True)
class NodeAccess:
    """The planned nodes as bring-up, a check and homing reach them.

    Attributes:
        network: SDO and NMT, pumped.
        watch: sees every boot-up, heartbeat and EMCY that arrives meanwhile.
        setups: configurations of the nodes.
        settings: times, retries, and whether the nodes store their configuration.
        say: called with each step, for the user.
    """

    network: PumpedNetwork
    watch: NodeWatch
    setups: tuple[NodeConfiguration, ...]
    settings: BringUpSettings
    say: Callable[[str], None]

    def dialogues(self, dialogues: Mapping[int, Dialogue]) -> Dialogues:
        """Dialogues by node id, for a caller that serves them."""
        return Dialogues(self.network, dialogues, timeout_s=self.settings.sdo_s, retries=self.settings.retries)

    def talk(self, dialogues: Mapping[int, Dialogue], timeout_s: float | None = None) -> dict[int, int]:
        """Hold dialogues by node id to their end; the number of requests that were sent again, by node id."""
        timeout_s = self.settings.sdo_s if timeout_s is None else timeout_s
        return hold_dialogues(self.network, dialogues, timeout_s=timeout_s, retries=self.settings.retries)


class BringUp:
    """Brings the planned nodes up over one network.

    Args:
        access: the nodes.
        listened: whether the caller has listened for another master until now.
        resets: whether the nodes are reset; else they are only made pre-operational, and keep what they hold.

    Attributes:
        took_over: the nodes were reset by this cell. Before that it must not send: another master may use them.
        released: nodes that confirmed on the way out that they watch this master no more.
    """

    def __init__(self, access: NodeAccess, *, listened: bool, resets: bool) -> None:
        self._access, self._network, self._watch = access, access.network, access.watch
        self._setups, self._settings, self._say = access.setups, access.settings, access.say
        self._nodes = {setup.node_id: NodeBringUp(setup, access.watch) for setup in access.setups}
        self._booted: dict[int, int] = {}
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
        # once more: on a bus full of SDOs a boot-up (700h + id) is heard only behind them
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
        # a second device of a node id has heard the same reset, and its boot-up may still be on its way
        self._network.pump_until(lambda: False, SECOND_ANSWER_S)
        self._booted = dict(boot_ups)
        for setup in self._setups:
            count = self._booted[setup.node_id] - before[setup.node_id]
            if count > resets[setup.node_id]:
                self._refuse_twins(setup, count)

    def _refuse_twins(self, setup: NodeConfiguration, boot_ups: int) -> None:
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
        nodes, stores = self._nodes, self._settings.store
        repeated = self._access.talk({i: node.configure(store=stores) for i, node in nodes.items()})
        failures = [self._error(n.failure.reason, n.setup) for n in nodes.values() if n.failure is not None]
        if failures:
            first, *others = failures
            raise NodeError(first.node_id, "; ".join([first.reason, *map(str, others)]))
        for node_id, node in nodes.items():
            node.repeated = repeated.get(node_id, 0)
            self._say(str(node))
            name = f"node {node_id}: ({node.setup.name})"
            for remark in node.remarks:
                self._say(f"{name} {remark}")
            if left := ", ".join(dict.fromkeys(f"{write.index:04X}h" for write in node.setup.left_out)):
                self._say(f"{name} cannot take {left} by its EDS: left as the device has it")

    # 4. start

    def _start(self) -> None:
        self._watch.forget()
        waiting = list(self._setups)
        for _ in range(1 + self._settings.retries):
            all_of_them = len(waiting) == len(self._setups)
            which = "all nodes" if all_of_them else f"nodes {', '.join(str(s.node_id) for s in waiting)} again"
            self._say(f"start {which}")
            # each by its id, not all by id 0: devices that are not in the scene stay as they are
            self._network.port.send_batch([pack_nmt(NmtCommand.START, s.node_id) for s in waiting])
            self._network.pump_until(lambda: not self._not_operational(), self._settings.start_s)
            if not (waiting := self._not_operational()):
                return
        self._access.talk({setup.node_id: self._nodes[setup.node_id].recall() for setup in waiting}, RELEASE_S)
        state = self._watch.states.get(waiting[0].node_id)
        tries = f", {1 + self._settings.retries} times" if self._settings.retries else ""
        raise self._error(
            f"({waiting[0].name}) is not operational {self._settings.start_s:g} s after NMT start{tries}:"
            f" {'no heartbeat' if state is None else state.name}{_others('nor are', waiting)}",
            *waiting,
        )

    def _not_operational(self) -> list[NodeConfiguration]:
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
        return self._access.dialogues(asked)

    def tares(self, node_id: int) -> Dialogues:
        """Have the array tared anew: to be served while cycling."""
        write = Write(TARE_COMMAND, 0, TARE, "tare", read_back=False)
        return self._access.dialogues({s.node_id: write_entry(s, write) for s in self._setups if s.node_id == node_id})

    def _confirm_mode(self, setup: NodeConfiguration, mode: int, until_ns: int) -> Dialogue:
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

        def ask(setup: NodeConfiguration) -> Dialogue:
            with contextlib.suppress(NodeError):
                found[setup.node_id] = yield from read_entry(setup, IDENTITY, SERIAL_SUBINDEX)

        self._access.talk({s.node_id: ask(s) for s in self._setups if s.node_id in node_ids})
        return found

    # the way out

    def release(self) -> None:
        """Take the nodes that were taken over out of operation: pre-operational, heartbeat consumers off."""
        if not self.took_over:
            return
        self._network.port.send_batch([pack_nmt(NmtCommand.PRE_OPERATIONAL, s.node_id) for s in self._setups])
        # NMT went first: PDOs end at once, and SDO works in pre-operational all the same
        failures: list[NodeError] = []

        def consumer_off(setup: NodeConfiguration) -> Dialogue:
            # left on, each node would report the loss of its master (8130h) 250 ms after the last heartbeat
            has_one = any(write.index == HEARTBEAT_CONSUMER for write in setup.writes)
            if setup.node_id not in self._booted or not has_one:
                return
            if HEARTBEAT_CONSUMER in self._nodes[setup.node_id].refused:
                return
            try:
                yield from write_entry(setup, Write(HEARTBEAT_CONSUMER, 1, 0, "the master leaves"))
                self.released.add(setup.node_id)
            except NodeError as error:
                failures.append(error)

        self._access.talk({setup.node_id: consumer_off(setup) for setup in self._setups}, RELEASE_S)
        if failures:
            raise failures[0]

    def _error(self, reason: str, *setups: NodeConfiguration) -> NodeError:
        """The error of these nodes, with the last EMCY of each of them."""
        ids = [setup.node_id for setup in setups]
        return NodeError(ids[0], reason + "".join([self._nodes[node_id].last_words() for node_id in ids]))


def _others(words: str, setups: Sequence[NodeConfiguration]) -> str:
    names = ", ".join(f"{s.node_id} ({s.name})" for s in setups[1:])
    return f"; {words} {names}" if names else ""


_COMMANDS = {NmtState.OPERATIONAL: NmtCommand.START, NmtState.STOPPED: NmtCommand.STOP}


class FoundNodes:
    """Reads the nodes, and puts back what was changed.

    Args:
        access: the nodes.

    Attributes:
        remarks: what could not be put back.
    """

    def __init__(self, access: NodeAccess) -> None:
        self._access, self._setups = access, access.setups
        self._values: dict[int, dict[tuple[int, int], int]] = {}
        self._states: dict[int, NmtState] = {}
        self.remarks: list[str] = []

    def look(self) -> None:
        """Read the nodes.

        Raises:
            NodeError: a drive is under power: somebody works with it.
        """
        self._states = dict(self._access.watch.states)
        self._values = {setup.node_id: {} for setup in self._setups}
        self._access.talk({setup.node_id: self._read(setup) for setup in self._setups})

    def restore(self) -> None:
        """Put back what was changed, then the NMT states; a node whose state was not known stays pre-operational."""
        self._access.talk({setup.node_id: self._write(setup) for setup in self._setups})
        known = [(node_id, state) for node_id, state in self._states.items() if state in _COMMANDS]
        self._access.network.port.send_batch([pack_nmt(_COMMANDS[state], node_id) for node_id, state in known])

    def _read(self, setup: NodeConfiguration) -> Dialogue:
        found = self._values[setup.node_id]
        try:
            if setup.mode is not None:
                word = yield from read_entry(setup, STATUSWORD, 0)
                if (state := state_of(word)) in POWERED_STATES:
                    raise setup.error(f"is {state.name}: somebody works with this cell; a check needs it disabled")
            for place in dict.fromkeys((write.index, write.subindex) for write in setup.writes):
                try:
                    found[place] = yield from read_entry(setup, *place)
                except NodeError as error:
                    if not isinstance(error.__cause__, SdoAbortedError):
                        raise
        except NodeError as error:
            if not isinstance(error.__cause__, SdoTimeoutError | SdoCommunicationError):
                raise  # else bring-up says that the node does not answer

    def _write(self, setup: NodeConfiguration) -> Dialogue:
        for write in self._writes_back(setup):
            try:
                yield from write_entry(setup, write)
            except NodeError as error:
                self.remarks.append(f"node {setup.node_id}: {write.place} could not be put back: {error.reason}")
                if isinstance(error.__cause__, SdoTimeoutError):
                    return

    def _writes_back(self, setup: NodeConfiguration) -> Iterator[Write]:
        """The writes of bring-up in their order, the last to each entry with the value that was found.

        Also where that is the value that bring-up writes: it may have been interrupted while a PDO was switched off.
        """
        found = self._values[setup.node_id]
        last = {(write.index, write.subindex): number for number, write in enumerate(setup.writes)}
        for number, write in enumerate(setup.writes):
            place = write.index, write.subindex
            if place in found:
                value = found[place] if last[place] == number else write.value
                yield Write(write.index, write.subindex, value, "as it was found", own_bits=write.own_bits)
