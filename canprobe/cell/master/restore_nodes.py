"""Nodes as a check found them: their NMT state and what bring-up writes in them, read before and put back after.

A node that is not reset keeps the rest: its zero, and what another tool has set up. An entry that it did not give, or
does not take back, is named.
"""

from __future__ import annotations

from collections.abc import Iterator

from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from canprobe.cell.master.entries import read_entry, write_entry
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.node_configuration import NodeConfiguration, Write
from canprobe.cell.scene.hardware import BringUpSettings
from canprobe.errors import NodeError
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.sdo import Dialogue, SdoTimeoutError, hold_dialogues
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, STATUSWORD, state_of
from canprobe.fieldbus.protocol.frames import NmtCommand, NmtState, pack_nmt

_COMMANDS = {NmtState.OPERATIONAL: NmtCommand.START, NmtState.STOPPED: NmtCommand.STOP}


class FoundNodes:
    """Reads the nodes, and puts back what was changed.

    Args:
        network: SDO and NMT, pumped.
        watch: what the nodes reported so far.
        setups: the configurations that bring-up writes.
        settings: times and retries.

    Attributes:
        remarks: what could not be put back.
    """

    def __init__(
        self, network: PumpedNetwork, watch: NodeWatch, setups: tuple[NodeConfiguration, ...], settings: BringUpSettings
    ) -> None:
        self._network, self._watch, self._setups, self._settings = network, watch, setups, settings
        self._values: dict[int, dict[tuple[int, int], int]] = {}
        self._states: dict[int, NmtState] = {}
        self.remarks: list[str] = []

    def look(self) -> None:
        """Read the nodes.

        Raises:
            NodeError: a drive is under power: somebody works with it.
        """
        self._states = dict(self._watch.states)
        self._values = {setup.node_id: {} for setup in self._setups}
        self._talk({setup.node_id: self._read(setup) for setup in self._setups})

    def restore(self) -> None:
        """Put back what was changed, then the NMT states; a node whose state was not known stays pre-operational."""
        self._talk({setup.node_id: self._write(setup) for setup in self._setups})
        states = self._states.items()
        self._network.port.send_batch([pack_nmt(_COMMANDS[s], node_id) for node_id, s in states if s in _COMMANDS])

    def _talk(self, dialogues: dict[int, Dialogue]) -> None:
        hold_dialogues(self._network, dialogues, timeout_s=self._settings.sdo_s, retries=self._settings.retries)

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
