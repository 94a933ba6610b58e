"""LSS slave: the node gets its id over the bus. Without an id it stays in initialisation and only hears LSS.

An id that was configured holds from the next NMT reset communication on. A node without an id makes that reset by
itself when it is switched back to waiting. An id that was stored holds after the next power on. The bit rate is that
of the bus; any other one is refused.
Source: CiA 305, "LSS slave", "LSS services".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from canprobe.fieldbus.node.core import NodeCore, Route, Service
from canprobe.fieldbus.node.store import Store
from canprobe.fieldbus.protocol import lss
from canprobe.fieldbus.protocol.lss import LssAddress, LssCommand, LssError, LssState
from canprobe.fieldbus.protocol.sdo import SdoAbort

_SELECT_COMMANDS = range(LssCommand.SELECT_VENDOR, LssCommand.SELECT_SERIAL + 1)
_IDENTIFY_COMMANDS = range(LssCommand.IDENTIFY_VENDOR, LssCommand.IDENTIFY_SERIAL_HIGH + 1)
_NUMBER_MASK = 0xFFFFFFFF
_INQUIRE_COMMANDS = range(LssCommand.INQUIRE_VENDOR, LssCommand.INQUIRE_SERIAL + 1)


class LssSlave(Service):
    """The LSS service of one node.

    Args:
        core: core of the node; its `node_id` is the active one.
        store: store for the id that "store configuration" stores.
        reset: function that is called with the time when a node that had no id boots with its new one.
        bitrate: bit rate of the bus, bit/s.

    Attributes:
        pending: node id from the next reset communication on, or `UNCONFIGURED_ID`.
        state: waiting or configuration.
        bitrate: bit rate of the bus, bit/s.
    """

    def __init__(self, core: NodeCore, store: Store, reset: Callable[[int], None], bitrate: int = 1_000_000) -> None:
        self._core, self._store, self._reset, self.bitrate = core, store, reset, bitrate
        self.pending = core.node_id
        self.state = LssState.WAITING
        self._search = LssSearch()

    @property
    def address(self) -> LssAddress:
        """The LSS address, which 1018h holds."""
        return LssAddress(*(self._core.dictionary.number(0x1018, subindex) for subindex in (1, 2, 3, 4)))

    @property
    def unconfigured(self) -> bool:
        """Whether the node has no id and waits for one."""
        return self._core.node_id == lss.UNCONFIGURED_ID

    def power_on(self) -> None:
        """Take the stored id, if there is one."""
        if self._store.node_id is not None:
            self.pending = self._store.node_id

    def reset(self, t_ns: int) -> None:
        """Go back to waiting, with nothing heard."""
        self._enter(LssState.WAITING)

    def routes(self) -> Mapping[int, Route]:
        """Identifier of the LSS master, in every NMT state."""
        return {lss.LSS_REQUEST_ID: self._receive}

    def _receive(self, data: bytes, t_ns: int) -> None:
        if len(data) != lss.LSS_BYTES:
            return
        if data[0] == LssCommand.SWITCH_GLOBAL:
            self._switch(data[1], t_ns)
            return
        answer = self._searched(data)
        if answer is None and self.state is LssState.CONFIGURATION:
            answer = self._configured(data)
        if answer is not None:
            self._core.send(lss.LSS_ANSWER_ID, answer)

    def _switch(self, mode: int, t_ns: int) -> None:
        if mode not in tuple(LssState):
            return
        boots = self.state is LssState.CONFIGURATION and self.unconfigured and self.pending != lss.UNCONFIGURED_ID
        self._enter(LssState(mode))
        if boots and mode == LssState.WAITING:
            self._reset(t_ns)

    def _enter(self, state: LssState) -> None:
        self.state = state
        self._search.forget()

    def _searched(self, data: bytes) -> bytes | None:
        """Answer the questions by which a master finds the slave; only a slave without an id answers fastscan."""
        command, waits = data[0], self.state is LssState.WAITING
        blank = self.unconfigured and self.pending == lss.UNCONFIGURED_ID  # it has no id, and was given none yet
        if command in _IDENTIFY_COMMANDS and self._search.identifies(data, self.address):
            return lss.pack_lss(LssCommand.IDENTIFIED)
        if command == LssCommand.IDENTIFY_UNCONFIGURED and blank:
            return lss.pack_lss(LssCommand.IDENTIFIED_UNCONFIGURED)
        if waits and command in _SELECT_COMMANDS and self._search.selects(data, self.address):
            self._enter(LssState.CONFIGURATION)
            return lss.pack_lss(LssCommand.SELECTED)
        if waits and command == LssCommand.FASTSCAN and blank:
            matches, found = self._search.fastscan(data, self.address)
            if found:
                self._enter(LssState.CONFIGURATION)
            return lss.pack_lss(LssCommand.IDENTIFIED) if matches else None
        return None

    def _configured(self, data: bytes) -> bytes | None:
        """Answer the questions and orders of a master in configuration state."""
        command, error = data[0], LssError.NONE
        if command in _INQUIRE_COMMANDS:
            return lss.pack_number(LssCommand(command), self.address.numbers[command - _INQUIRE_COMMANDS[0]])
        if command == LssCommand.INQUIRE_NODE_ID:  # in initialisation the pending one, which becomes active
            node_id = self.pending if self.unconfigured else self._core.node_id
            return lss.pack_lss(LssCommand(command), bytes((node_id,)))
        if command == LssCommand.CONFIGURE_NODE_ID:
            if 1 <= data[1] <= 127 or data[1] == lss.UNCONFIGURED_ID:
                self.pending = data[1]
            else:
                error = LssError.REFUSED
        elif command == LssCommand.CONFIGURE_BIT_TIMING:
            if data[1] != 0 or lss.BIT_RATES.get(data[2]) != self.bitrate:
                error = LssError.REFUSED
        elif command == LssCommand.STORE:
            try:
                self._store.keep_node_id(self.pending)
            except SdoAbort:
                error = LssError.STORE_FAILED
        else:
            return None
        return lss.pack_lss(LssCommand(command), bytes((error,)))


class LssSearch:
    """Questions that one slave has heard so far: for its whole address, for bounds, or bit by bit.

    Source: CiA 305, switch state selective, identify remote slave, fastscan.
    """

    def __init__(self) -> None:
        self._heard: list[tuple[int, int]] = []  # command and number, of the sequence under way
        self._position = 0

    def forget(self) -> None:
        """Forget all questions."""
        self._heard.clear()
        self._position = 0

    def selects(self, data: bytes, mine: LssAddress) -> bool:
        """Switch state selective: the four numbers come one after another, and the last one decides."""
        return tuple(self._complete(data, _SELECT_COMMANDS)) == mine.numbers

    def identifies(self, data: bytes, mine: LssAddress) -> bool:
        """Identify remote slave: vendor and product, and a lowest and a highest revision and serial number."""
        numbers = self._complete(data, _IDENTIFY_COMMANDS)
        if not numbers:
            return False
        vendor, product, revision_low, revision_high, serial_low, serial_high = numbers
        low, high = (vendor, product, revision_low, serial_low), (vendor, product, revision_high, serial_high)
        return all(first <= number <= last for first, number, last in zip(low, mine.numbers, high, strict=True))

    def fastscan(self, data: bytes, mine: LssAddress) -> tuple[bool, bool]:
        """Whether the asked bits of one number are mine, and whether the whole address is found."""
        bit, position, following = data[5:]
        if not (bit < 32 or bit == lss.PRESENCE_CHECK) or position > 3 or following > 3:
            return False, False
        if bit == lss.PRESENCE_CHECK:
            self._position = 0
            return True, False
        asked = _NUMBER_MASK << bit & _NUMBER_MASK
        if position != self._position or (_number_in(data) ^ mine.numbers[position]) & asked:
            return False, False
        self._position = following
        # after the serial number (3) the master goes on to the vendor id (0): the whole address is found
        return True, bit == 0 and following < position

    def _complete(self, data: bytes, sequence: range) -> list[int]:
        """Take one number of a sequence; return all of them after the last one, if none was left out, else nothing."""
        if data[0] != sequence[0] and (not self._heard or self._heard[-1][0] != data[0] - 1):
            self._heard.clear()
            return []
        if data[0] == sequence[0]:
            self._heard.clear()
        self._heard.append((data[0], _number_in(data)))
        return [number for _, number in self._heard] if data[0] == sequence[-1] else []


def _number_in(data: bytes) -> int:
    """Number in the 32 bits behind the command specifier."""
    return int.from_bytes(data[1:5], "little")
