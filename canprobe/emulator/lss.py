"""LSS slave: the node gets its id over the bus. Without one it stays in initialisation and hears LSS alone.

An id that was configured is used from the next NMT reset communication on; a node that had none makes that reset by
itself when it is switched back to waiting. What was stored is used after the next power on. The bit rate is that of
the bus: another one is refused.
Source: CiA 305, "LSS slave", "LSS services".
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

from canprobe.emulator.aborts import SdoAbort
from canprobe.emulator.core import NodeCore, Route
from canprobe.emulator.entries import key_of
from canprobe.emulator.lss_search import IDENTIFY, SELECT, LssSearch, Match
from canprobe.emulator.store import Store
from canprobe.protocol.lss import (
    BIT_RATES,
    LSS_ANSWER_ID,
    LSS_LENGTH,
    LSS_REQUEST_ID,
    UNCONFIGURED,
    LssAddress,
    LssCommand,
    LssError,
    LssState,
    pack_lss,
    pack_number,
)

if TYPE_CHECKING:
    from canprobe.emulator.node import SlaveNode

Answer = bytes | None
_INQUIRE = range(LssCommand.INQUIRE_VENDOR, LssCommand.INQUIRE_SERIAL + 1)


class LssSlave:
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
        self._in_both_states: dict[int, Callable[[bytes], Answer]] = {
            LssCommand.IDENTIFY_UNCONFIGURED: self._identify_unconfigured,
            **dict.fromkeys(IDENTIFY, self._identify),
        }
        self._in_waiting: dict[int, Callable[[bytes], Answer]] = {
            LssCommand.FASTSCAN: self._fastscan,
            **dict.fromkeys(SELECT, self._select),
        }
        self._in_configuration: dict[int, Callable[[bytes], Answer]] = {
            LssCommand.CONFIGURE_NODE_ID: self._configure_node_id,
            LssCommand.CONFIGURE_BIT_TIMING: self._configure_bit_timing,
            LssCommand.STORE: self._store_configuration,
            LssCommand.INQUIRE_NODE_ID: self._inquire_node_id,
            **dict.fromkeys(_INQUIRE, self._inquire),
        }

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

    def entered(self, t_ns: int) -> None:
        """LSS works in every NMT state."""

    def routes(self) -> Mapping[int, Route]:
        """The LSS master's messages."""
        return {LSS_REQUEST_ID: self._receive}

    def _receive(self, data: bytes, t_ns: int) -> None:
        if len(data) != LSS_LENGTH:
            return
        if data[0] == LssCommand.SWITCH_GLOBAL:
            self._switch(data[1], t_ns)
            return
        in_state = self._in_configuration if self.state is LssState.CONFIGURATION else self._in_waiting
        act = self._in_both_states.get(data[0]) or in_state.get(data[0])
        answer = act(data) if act is not None else None
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

    # ------------------------------------------------------------------ being found

    @property
    def _is_blank(self) -> bool:
        """It has no id and was not given one yet: the searches are for such nodes alone."""
        return self.unconfigured and self.pending == UNCONFIGURED

    def _select(self, data: bytes) -> Answer:
        if not self._search.selects(data, self.address):
            return None
        self._enter(LssState.CONFIGURATION)
        return pack_lss(LssCommand.SELECTED)

    def _identify(self, data: bytes) -> Answer:
        return pack_lss(LssCommand.IDENTIFIED) if self._search.identifies(data, self.address) else None

    def _identify_unconfigured(self, _: bytes) -> Answer:
        return pack_lss(LssCommand.IDENTIFIED_UNCONFIGURED) if self._is_blank else None

    def _fastscan(self, data: bytes) -> Answer:
        match = self._search.fastscan(data, self.address) if self._is_blank else Match.NO
        if match is Match.FOUND:
            self._enter(LssState.CONFIGURATION)
        return pack_lss(LssCommand.IDENTIFIED) if match is not Match.NO else None

    # ------------------------------------------------------------------ being configured

    def _configure_node_id(self, data: bytes) -> Answer:
        fits = 1 <= data[1] <= 127 or data[1] == UNCONFIGURED
        if fits:
            self.pending = data[1]
        return _verdict(LssCommand.CONFIGURE_NODE_ID, LssError.NONE if fits else LssError.REFUSED)

    def _configure_bit_timing(self, data: bytes) -> Answer:
        same = data[1] == 0 and BIT_RATES.get(data[2]) == self.bitrate
        return _verdict(LssCommand.CONFIGURE_BIT_TIMING, LssError.NONE if same else LssError.REFUSED)

    def _store_configuration(self, _: bytes) -> Answer:
        try:
            self._store.keep_node_id(self.pending)
        except SdoAbort:
            return _verdict(LssCommand.STORE, LssError.STORE_FAILED)
        return _verdict(LssCommand.STORE, LssError.NONE)

    def _inquire(self, data: bytes) -> Answer:
        return pack_number(LssCommand(data[0]), self.address.numbers[data[0] - _INQUIRE[0]])

    def _inquire_node_id(self, _: bytes) -> Answer:
        """The active id; in initialisation the pending one, which is about to be."""
        node_id = self.pending if self.unconfigured else self._core.node_id
        return pack_lss(LssCommand.INQUIRE_NODE_ID, bytes((node_id,)))


def set_serial_number(node: SlaveNode, serial: int) -> None:
    """Tell two devices of one EDS apart; a device without 1018h:04 has none."""
    if key_of(0x1018, 4) in node.dictionary:
        node.dictionary.set_default(0x1018, 4, serial)


def _verdict(command: LssCommand, error: LssError) -> bytes:
    return pack_lss(command, bytes((error,)))
