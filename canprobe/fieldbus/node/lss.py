"""LSS slave: the node gets its id over the bus; and the memory that ids and parameters (1010h, 1011h) are kept in.

An id that was configured is used from the next NMT reset communication on; a node that had none makes that reset by
itself when it is switched back to waiting. What was stored is used after the next power on. The bit rate is that of
the bus: another one is refused.
Source: CiA 305, "LSS slave", "LSS services".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from canprobe.fieldbus.node.core import NodeCore, Route, Service
from canprobe.fieldbus.node.dictionary import Abort, SdoAbort, Value, nothing
from canprobe.fieldbus.protocol.frames import (
    BIT_RATES,
    LSS_ANSWER_ID,
    LSS_LENGTH,
    LSS_REQUEST_ID,
    NOTHING_ASKED,
    UNCONFIGURED,
    LssAddress,
    LssCommand,
    LssError,
    LssState,
    pack_lss,
    pack_number,
)

# How an LSS slave is found among others: by its whole address, by bounds, or bit by bit.
#
# Source: CiA 305, switch state selective, identify remote slave, fastscan.

SELECT = range(LssCommand.SELECT_VENDOR, LssCommand.SELECT_SERIAL + 1)
IDENTIFY = range(LssCommand.IDENTIFY_VENDOR, LssCommand.IDENTIFY_SERIAL_HIGH + 1)
_MASK = 0xFFFFFFFF


class LssSearch:
    """What one slave has heard of the questions so far."""

    def __init__(self) -> None:
        self._heard: list[tuple[int, int]] = []  # command and number, of the sequence under way
        self._position = 0

    def forget(self) -> None:
        """Start again."""
        self._heard.clear()
        self._position = 0

    def selects(self, data: bytes, mine: LssAddress) -> bool:
        """Switch state selective: the four numbers one after another, the last one decides."""
        return tuple(self._complete(data, SELECT)) == mine.numbers

    def identifies(self, data: bytes, mine: LssAddress) -> bool:
        """Identify remote slave: vendor and product, revision and serial number each from a lowest to a highest."""
        numbers = self._complete(data, IDENTIFY)
        if not numbers:
            return False
        vendor, product, revision_low, revision_high, serial_low, serial_high = numbers
        return (
            (vendor, product) == (mine.vendor_id, mine.product_code)
            and revision_low <= mine.revision_number <= revision_high
            and serial_low <= mine.serial_number <= serial_high
        )

    def fastscan(self, data: bytes, mine: LssAddress) -> tuple[bool, bool]:
        """The bits of one number from the asked one upwards: whether they are mine, and with them the whole address."""
        bit, position, following = data[5:]
        if not (bit < 32 or bit == NOTHING_ASKED) or position > 3 or following > 3:
            return False, False
        if bit == NOTHING_ASKED:
            self._position = 0
            return True, False
        asked = _MASK << bit & _MASK
        if position != self._position or (_number_in(data) ^ mine.numbers[position]) & asked:
            return False, False
        self._position = following
        return True, bit == 0 and following < position

    def _complete(self, data: bytes, sequence: range) -> list[int]:
        """Take one number of a sequence; all of them where it is the last one and none was left out, else nothing."""
        if data[0] != sequence[0] and (not self._heard or self._heard[-1][0] != data[0] - 1):
            self._heard.clear()
            return []
        if data[0] == sequence[0]:
            self._heard.clear()
        self._heard.append((data[0], _number_in(data)))
        return [number for _, number in self._heard] if data[0] == sequence[-1] else []


def _number_in(data: bytes) -> int:
    """The 32 bits behind the command specifier."""
    return int.from_bytes(data[1:5], "little")


# Store and restore parameters (1010h, 1011h) in a memory that survives the resets of the node.
#
# Source: CiA 301, objects 1010h, 1011h and 1020h.

SAVE = int.from_bytes(b"save", "little")
LOAD = int.from_bytes(b"load", "little")
_ALL = range(0x1000, 0x10000)
_COMMUNICATION = range(0x1000, 0x2000)
_APPLICATION = range(0x2000, 0x10000)
_COMMUNICATION_ONLY = 2
_GROUPS = {1: _ALL, 2: _COMMUNICATION, 3: _APPLICATION}
_VERIFY = 0x1020
_NEVER = frozenset({0x1003, 0x1010, 0x1011})


class Store:
    """Parameters of one node, kept by "save" and forgotten by "load" (from the next reset on).

    Attributes:
        saved: stored values by dictionary key; hand it to another node's store to model a power cycle.
        kept: what the application stored beside the dictionary.
        volatile: indices that are process data, never stored.
        node_id: stored by LSS for the next power on, 255 for none; None where LSS never stored any.
        changed: called after every "save" and "load"; it may raise SdoAbort, then nothing has changed.
    """

    def __init__(self, core: NodeCore, keep: Callable[[], bytes]) -> None:
        """`keep()` returns what "save" stores of the application beside the dictionary."""
        self._core, self._keep = core, keep
        self.saved: dict[int, Value] = {}
        self.kept = b""
        self.node_id: int | None = None
        self.changed: Callable[[], None] = nothing
        self.volatile: set[int] = set()
        core.dictionary.configured = self._unverify
        for index, act in ((0x1010, self._save), (0x1011, self._load)):
            core.dictionary.on_check(index, act)
            core.dictionary.on_write(index, self._show)

    def recall(self, communication_only: bool) -> None:
        """Defaults of the EDS, then what was stored; all of it, or the communication area alone."""
        area = _COMMUNICATION if communication_only else range(0x10000)
        dictionary = self._core.dictionary
        dictionary.restore(key for key in dictionary.entries if key >> 8 in area)
        for key, value in self.saved.items():
            if key >> 8 in area:
                dictionary.values[key] = value

    def keep_node_id(self, node_id: int) -> None:
        """Store a node id (LSS store configuration). Raises SdoAbort when it could not be written."""
        self._replace(self.saved, self.kept, node_id)

    def _save(self, subindex: int, value: Value) -> None:
        if value != SAVE or subindex not in _GROUPS:
            raise SdoAbort(Abort.CANNOT_STORE)
        dictionary, skip = self._core.dictionary, _NEVER | self.volatile
        saved = dict(self.saved)
        for key, entry in dictionary.entries.items():
            if entry.writable and entry.readable and key >> 8 in _GROUPS[subindex] and key >> 8 not in skip:
                saved[key] = dictionary.values[key]
        self._replace(saved, self.kept if subindex == _COMMUNICATION_ONLY else self._keep(), self.node_id)

    def _load(self, subindex: int, value: Value) -> None:
        if value != LOAD or subindex not in _GROUPS:
            raise SdoAbort(Abort.CANNOT_STORE)
        saved = {key: kept for key, kept in self.saved.items() if key >> 8 not in _GROUPS[subindex]}
        self._replace(saved, self.kept if subindex == _COMMUNICATION_ONLY else b"", self.node_id)

    def _replace(self, saved: dict[int, Value], kept: bytes, node_id: int | None) -> None:
        before = self.saved, self.kept, self.node_id
        self.saved, self.kept, self.node_id = saved, kept, node_id
        try:
            self.changed()
        except SdoAbort:
            self.saved, self.kept, self.node_id = before
            raise

    def _unverify(self, index: int) -> None:
        """Another value came over SDO: 1020h no longer identifies the configuration."""
        if index == _VERIFY or index in _NEVER or index in self.volatile:
            return
        for subindex in (1, 2):
            self._core.dictionary.put(_VERIFY, subindex, 0)

    def _show(self, subindex: int, value: Value) -> None:
        for index in (0x1010, 0x1011):
            for sub in _GROUPS:
                self._core.dictionary.put(index, sub, 1)


# LSS slave: the node gets its id over the bus. Without one it stays in initialisation and hears LSS alone.

_INQUIRE = range(LssCommand.INQUIRE_VENDOR, LssCommand.INQUIRE_SERIAL + 1)


class LssSlave(Service):
    """The LSS service of one node.

    Args:
        core: of the node; its `node_id` is the active one.
        store: keeps the id that "store configuration" stores.
        reset: called with the time when a node that had no id is to boot with its new one.
        bitrate: see below.

    Attributes:
        pending: node id from the next reset communication on, or `UNCONFIGURED`.
        state: waiting or configuration.
        bitrate: of the bus, bit/s.
    """

    def __init__(self, core: NodeCore, store: Store, reset: Callable[[int], None], bitrate: int = 1_000_000) -> None:
        self._core, self._store, self._reset, self.bitrate = core, store, reset, bitrate
        self.pending = core.node_id
        self.state = LssState.WAITING
        self._search = LssSearch()

    @property
    def address(self) -> LssAddress:
        """What 1018h holds."""
        return LssAddress(*(self._core.dictionary.number(0x1018, subindex) for subindex in (1, 2, 3, 4)))

    @property
    def unconfigured(self) -> bool:
        """The node has no id and waits for one."""
        return self._core.node_id == UNCONFIGURED

    def power_on(self) -> None:
        """Take the id that was stored, if one was."""
        if self._store.node_id is not None:
            self.pending = self._store.node_id

    def reset(self, t_ns: int) -> None:
        """Back to waiting, nothing heard."""
        self._enter(LssState.WAITING)

    def routes(self) -> Mapping[int, Route]:
        """The LSS master's messages, in every NMT state."""
        return {LSS_REQUEST_ID: self._receive}

    def _receive(self, data: bytes, t_ns: int) -> None:
        if len(data) != LSS_LENGTH:
            return
        if data[0] == LssCommand.SWITCH_GLOBAL:
            self._switch(data[1], t_ns)
            return
        answer = self._searched(data)
        if answer is None and self.state is LssState.CONFIGURATION:
            answer = self._configured(data)
        if answer is not None:
            self._core.send(LSS_ANSWER_ID, answer)

    def _switch(self, mode: int, t_ns: int) -> None:
        if mode not in tuple(LssState):
            return
        boots = self.state is LssState.CONFIGURATION and self.unconfigured and self.pending != UNCONFIGURED
        self._enter(LssState(mode))
        if boots and mode == LssState.WAITING:
            self._reset(t_ns)

    def _enter(self, state: LssState) -> None:
        self.state = state
        self._search.forget()

    def _searched(self, data: bytes) -> bytes | None:
        """Answer the questions by which a master finds the slave; fastscan is for slaves without an id alone."""
        command, waits = data[0], self.state is LssState.WAITING
        blank = self.unconfigured and self.pending == UNCONFIGURED  # no id, and it was not given one yet
        if command in IDENTIFY and self._search.identifies(data, self.address):
            return pack_lss(LssCommand.IDENTIFIED)
        if command == LssCommand.IDENTIFY_UNCONFIGURED and blank:
            return pack_lss(LssCommand.IDENTIFIED_UNCONFIGURED)
        if waits and command in SELECT and self._search.selects(data, self.address):
            self._enter(LssState.CONFIGURATION)
            return pack_lss(LssCommand.SELECTED)
        if waits and command == LssCommand.FASTSCAN and blank:
            matches, found = self._search.fastscan(data, self.address)
            if found:
                self._enter(LssState.CONFIGURATION)
            return pack_lss(LssCommand.IDENTIFIED) if matches else None
        return None

    def _configured(self, data: bytes) -> bytes | None:
        """Answer what a master asks and orders in configuration state."""
        command, error = data[0], LssError.NONE
        if command in _INQUIRE:
            return pack_number(LssCommand(command), self.address.numbers[command - _INQUIRE[0]])
        if command == LssCommand.INQUIRE_NODE_ID:  # in initialisation the pending one, which is about to be active
            return pack_lss(LssCommand(command), bytes((self.pending if self.unconfigured else self._core.node_id,)))
        if command == LssCommand.CONFIGURE_NODE_ID:
            if 1 <= data[1] <= 127 or data[1] == UNCONFIGURED:
                self.pending = data[1]
            else:
                error = LssError.REFUSED
        elif command == LssCommand.CONFIGURE_BIT_TIMING:
            if data[1] != 0 or BIT_RATES.get(data[2]) != self.bitrate:
                error = LssError.REFUSED
        elif command == LssCommand.STORE:
            try:
                self._store.keep_node_id(self.pending)
            except SdoAbort:
                error = LssError.STORE_FAILED
        else:
            return None
        return pack_lss(LssCommand(command), bytes((error,)))
