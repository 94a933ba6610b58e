"""Store and restore parameters (1010h, 1011h) in a memory that survives the resets of the node.

Source: CiA 301, objects 1010h, 1011h and 1020h.
"""

from __future__ import annotations

from collections.abc import Callable

from canprobe.fieldbus.bus.port import nothing
from canprobe.fieldbus.node.core import NodeCore
from canprobe.fieldbus.node.dictionary import Value
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

SAVE_SIGNATURE = int.from_bytes(b"save", "little")
LOAD_SIGNATURE = int.from_bytes(b"load", "little")
_ALL_INDICES = range(0x1000, 0x10000)
_COMMUNICATION_AREA = range(0x1000, 0x2000)
_APPLICATION_AREA = range(0x2000, 0x10000)
_COMMUNICATION_GROUP = 2
_GROUPS = {1: _ALL_INDICES, 2: _COMMUNICATION_AREA, 3: _APPLICATION_AREA}
_VERIFICATION_INDEX = 0x1020
_UNSTORED_INDICES = frozenset({0x1003, 0x1010, 0x1011})


class Store:
    """Parameters of one node, kept by "save" and forgotten by "load" (from the next reset on).

    Attributes:
        saved: stored values by dictionary key; hand it to another node's store to model a power cycle.
        kept: bytes that the application stored beside the dictionary.
        volatile: indices of process data, which are never stored.
        node_id: node id that LSS stored for the next power on, 255 for none; None where LSS never stored one.
        changed: function that is called after every "save" and "load"; where it raises SdoAbort, nothing changes.
    """

    def __init__(self, core: NodeCore, keep: Callable[[], bytes]) -> None:
        """Make an empty store; `keep()` returns what "save" stores of the application beside the dictionary."""
        self._core, self._keep = core, keep
        self.saved: dict[int, Value] = {}
        self.kept = b""
        self.node_id: int | None = None
        self.changed: Callable[[], None] = nothing
        self.volatile: set[int] = set()
        core.dictionary.configured = self._unverify
        for index, act in ((0x1010, self._save), (0x1011, self._load)):
            # as a check: where it cannot store, the write itself is aborted
            core.dictionary.on_check(index, act)
            core.dictionary.on_write(index, self._show)

    def recall(self, communication_only: bool) -> None:
        """Restore the defaults of the EDS, then what was stored: all of it, or the communication area alone."""
        area = _COMMUNICATION_AREA if communication_only else range(0x10000)
        dictionary = self._core.dictionary
        dictionary.restore(key for key in dictionary.entries if key >> 8 in area)
        for key, value in self.saved.items():
            if key >> 8 in area:
                dictionary.values[key] = value

    def keep_node_id(self, node_id: int) -> None:
        """Store a node id (LSS store configuration). Raises SdoAbort when it cannot be written."""
        self._replace(self.saved, self.kept, node_id)

    def _save(self, subindex: int, value: Value) -> None:
        if value != SAVE_SIGNATURE or subindex not in _GROUPS:
            raise SdoAbort(Abort.CANNOT_STORE)
        dictionary, skip = self._core.dictionary, _UNSTORED_INDICES | self.volatile
        saved = dict(self.saved)
        for key, entry in dictionary.entries.items():
            if entry.writable and entry.readable and key >> 8 in _GROUPS[subindex] and key >> 8 not in skip:
                saved[key] = dictionary.values[key]
        self._replace(saved, self.kept if subindex == _COMMUNICATION_GROUP else self._keep(), self.node_id)

    def _load(self, subindex: int, value: Value) -> None:
        if value != LOAD_SIGNATURE or subindex not in _GROUPS:
            raise SdoAbort(Abort.CANNOT_STORE)
        saved = {key: kept for key, kept in self.saved.items() if key >> 8 not in _GROUPS[subindex]}
        self._replace(saved, self.kept if subindex == _COMMUNICATION_GROUP else b"", self.node_id)

    def _replace(self, saved: dict[int, Value], kept: bytes, node_id: int | None) -> None:
        before = self.saved, self.kept, self.node_id
        self.saved, self.kept, self.node_id = saved, kept, node_id
        try:
            self.changed()
        except SdoAbort:
            self.saved, self.kept, self.node_id = before
            raise

    def _unverify(self, index: int) -> None:
        """Clear 1020h, as it no longer identifies the configuration once another value came over SDO."""
        if index == _VERIFICATION_INDEX or index in _UNSTORED_INDICES or index in self.volatile:
            return
        for subindex in (1, 2):
            self._core.dictionary.put(_VERIFICATION_INDEX, subindex, 0)

    def _show(self, subindex: int, value: Value) -> None:
        for index in (0x1010, 0x1011):
            for sub in _GROUPS:
                # the write has left its signature there; who reads gets bit 0: stores, or restores, on command
                self._core.dictionary.put(index, sub, 1)
