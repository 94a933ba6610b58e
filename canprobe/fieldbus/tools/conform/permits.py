"""What the bench may send to a device that is not ours: one gate that every frame passes, and the rule of each object.

Nothing of this can be switched off. Beside it `--write` permits what the user names, objects or words, and `--motion`
the objects that switch a drive on and move it.

| objects | rule |
| --- | --- |
| 1010h, 1011h, 1013h, 1021h–1026h, 1280h–13FFh, 1F00h–1FFFh | never written, whatever the value |
| 1000h–1002h, 1008h–100Ah, 1018h, 1027h | a write of the same value, which must be refused |
| 1003h | a value but 0, which must be refused; 0 erases the history: on request |
| 1005h, 1012h, 1014h | the same value, or a restricted identifier, which must be refused |
| 1020h, 1200h–127Fh | the same value |
| 1006h, 1007h, 100Ch, 100Dh, 1015h–1017h, 1019h, 1028h, 1029h, 1400h–1BFFh | changed and restored |
| 2000h and above | never without `--write`, not even the same value |

Frames: NMT to this node alone; no SYNC beside another producer; no heartbeat in the name of a node; LSS, identifiers
that belong to nobody, and background load only where the device is alone; RPDOs only where what they carry is harmless.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from canprobe.errors import UsageError
from canprobe.fieldbus.protocol import frames
from canprobe.fieldbus.protocol.lss import LSS_REQUEST_ID
from canprobe.fieldbus.protocol.pdo import PDO_OBJECTS
from canprobe.fieldbus.protocol.sdo import Place, place_of, place_text
from canprobe.fieldbus.tools.conform.outcome import NotPermitted
from canprobe.fieldbus.tools.conform.surroundings import Surroundings

WORDS = {
    "reset": "NMT reset node, which also resets application objects that nobody can restore",
    "history": "clearing the error history 1003h",
}
"""What `--write` permits beside objects."""
MOTION_OBJECTS = (0x6040, 0x6060, 0x607A, 0x6098)
"""Application objects that `--motion` permits: controlword, mode, target position, homing method."""
_ENTRY = re.compile(r"([0-9A-Fa-f]{4})h?(?:-([0-9A-Fa-f]{4})h?|:([0-9A-Fa-f]{1,2}))?")


class WriteRule(Enum):
    """What may be written to an object, with the objects of the communication area that have this rule."""

    NEVER = (*range(0x1021, 0x1027), *range(0x1280, 0x1400), *range(0x1F00, 0x2000), 0x1010, 0x1011, 0x1013)
    REFUSED = (0x1000, 0x1001, 0x1002, 0x1008, 0x1009, 0x100A, 0x1018, 0x1027)
    HISTORY = (0x1003,)
    IDENTIFIER = (0x1005, 0x1012, 0x1014)
    SAME = (0x1020, *range(0x1200, 0x1280))
    CHANGED = (0x1006, 0x1007, 0x100C, 0x100D, *range(0x1015, 0x1018), 0x1019, 0x1028, 0x1029, *PDO_OBJECTS)
    APPLICATION = (0x2000,)  # and all above


_TIME_ID = 0x100
_RULES = {index: rule for rule in WriteRule for index in rule.value}


def is_object(index: int, *wanted: int) -> bool:
    """Whether an index is one of some objects of CiA 402, of any axis: those of the next one lie 800h above."""
    return index >= 0x6000 and 0x6000 | index & 0x7FF in wanted


def rule_of(index: int) -> WriteRule:
    """Rule of an object; one of the communication area that the table does not name is never written."""
    return _RULES.get(index, WriteRule.APPLICATION if index >= 0x2000 else WriteRule.NEVER)


@dataclass(frozen=True, slots=True)
class WriteList:
    """What the user permits: ranges of objects, single entries, and words of `WORDS`.

    Attributes:
        ranges: first and last index of each range.
        places: single entries.
        words: words.
    """

    ranges: tuple[tuple[int, int], ...] = ()
    places: frozenset[Place] = frozenset()
    words: frozenset[str] = frozenset()

    @classmethod
    def parse(cls, text: str) -> WriteList:
        """Read a list such as ``2000h-20FFh,6081h,60C2h:01,history``.

        Raises:
            UsageError: a part is none of these, or an object that is never written.
        """
        ranges, places, words = [], set(), set()
        for part in filter(None, (part.strip() for part in text.split(","))):
            if part in WORDS:
                words.add(part)
                continue
            match = _ENTRY.fullmatch(part)
            if match is None:
                raise UsageError(
                    f"--write {part}: expected an object such as 6081h, 60C2h:01 or 2000h-20FFh, or one of"
                    f" {', '.join(WORDS)}"
                )
            first = int(match[1], 16)
            last = int(match[2], 16) if match[2] else first
            if never := [index for index in range(first, last + 1) if rule_of(index) is WriteRule.NEVER]:
                raise UsageError(f"--write {part}: {never[0]:04X}h is never written")
            if match[3]:
                places.add((first, int(match[3], 16)))
            else:
                ranges.append((first, last))
        return cls(tuple(ranges), frozenset(places), frozenset(words))

    def with_motion(self) -> WriteList:
        """The list, with the objects that switch a drive on and move it."""
        return WriteList((*self.ranges, *((index, index) for index in MOTION_OBJECTS)), self.places, self.words)

    def permits(self, place: Place) -> bool:
        """Whether an entry is in the list."""
        return place in self.places or any(first <= place[0] <= last for first, last in self.ranges)


class Permits:
    """The gate of the bench.

    Args:
        node_id: id of the device.
        surroundings: what else is on the bus.
        written: what the user permits.

    Attributes:
        values: values before the examination, which can be restored.
        rpdo_ids: identifiers of the device's RPDOs, which are not sent to, but for `harmless`.
        harmless: identifiers of RPDOs that carry nothing but dummies and objects that the user permits.
    """

    def __init__(self, node_id: int, surroundings: Surroundings, written: WriteList) -> None:
        self.node_id, self.surroundings, self.written = node_id, surroundings, written
        self.values: Mapping[Place, bytes] = {}
        self.rpdo_ids: set[int] = set()
        self.harmless: set[int] = set()

    def check(self, can_id: int, data: bytes) -> Place | None:
        """Check a frame that is to be sent; return the entry that it writes, if it writes one.

        Raises:
            NotPermitted: it must not be sent here.
        """
        if can_id & (frames.EFF_FLAG | frames.RTR_FLAG):
            self._need("alone" if can_id & frames.EFF_FLAG or can_id & 0x7F != self.node_id else "")
        elif can_id == frames.NMT_ID:
            self._check_nmt(data)
        elif can_id == frames.SYNC_ID:
            self._need("sync")
        elif can_id == frames.SDO_RX_BASE + self.node_id:
            return self._check_request(data)
        elif frames.SDO_RX_BASE < can_id < frames.SDO_RX_BASE + 128 or can_id == _TIME_ID:
            raise NotPermitted(f"{can_id:03X}h is for other nodes")
        elif can_id in self.rpdo_ids and can_id not in self.harmless:
            raise NotPermitted(f"an RPDO ({can_id:03X}h) of the device carries objects that must not be changed")
        elif frames.HEARTBEAT_BASE < can_id < frames.HEARTBEAT_BASE + 128:
            producer = can_id - frames.HEARTBEAT_BASE
            if producer == self.node_id or producer in self.surroundings.others:
                raise NotPermitted(f"a heartbeat in the name of node {producer}, which is there")
        elif can_id == LSS_REQUEST_ID or can_id not in self.harmless:
            self._need("alone")
        return None

    def _need(self, need: str) -> None:
        if why := self.surroundings.lacks(need):
            raise NotPermitted(why)

    def _check_nmt(self, data: bytes) -> None:
        self._need("nmt")
        if len(data) < 2:
            self._need("alone")
        elif data[1] != self.node_id:
            raise NotPermitted("NMT commands go to the device alone")
        if data[:1] == bytes((frames.NmtCommand.RESET_NODE,)) and "reset" not in self.written.words:
            raise NotPermitted(f"--write reset permits {WORDS['reset']}")

    def _check_request(self, data: bytes) -> Place | None:
        """Check an SDO request by the entry that it begins to write; a segment was permitted with its transfer."""
        if len(data) != 8 or data[0] >> 5 not in (1, 6) or (data[0] >> 5 == 6 and data[0] & 1):
            return None
        place = place_of(data)
        size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
        value = data[4 : 4 + size] if data[0] >> 5 == 1 and data[0] & 2 else None
        self._check_write(place, value)
        return place

    def _check_write(self, place: Place, value: bytes | None) -> None:
        rule, same = rule_of(place[0]), value is not None and self.values.get(place, value) == value
        if rule is WriteRule.NEVER:
            raise NotPermitted(f"{place_text(*place)} is never written")
        if rule is not WriteRule.HISTORY and self.written.permits(place):
            return
        if rule is WriteRule.HISTORY and not (value and any(value)) and "history" not in self.written.words:
            raise NotPermitted(f"--write history permits {WORDS['history']}")
        if rule is WriteRule.IDENTIFIER and not same:
            number = int.from_bytes(value or b"", "little")
            if not (value and frames.is_restricted(number & 0x7FF)):
                raise NotPermitted(f"{place_text(*place)} may get its own value or a restricted identifier only")
        if rule is WriteRule.REFUSED and value is None:
            return  # the beginning of a transfer, which must be aborted
        if rule in (WriteRule.SAME, WriteRule.REFUSED) and not same:
            raise NotPermitted(f"{place_text(*place)} may get its own value only")
        if rule is WriteRule.APPLICATION:
            raise NotPermitted(f"{place_text(*place)} is an application object: --write {place[0]:04X}h permits it")
