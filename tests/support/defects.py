"""A device with one defect: what it hears or says is changed, in one place.

A defect is a function `hear(device, can_id, text)`, which returns None where the node takes the frame, a `Changed`
frame for it, or the answers in its place; or `say(device, can_id, text)`, which returns what the bus gets of a frame
of the node. Data are hex, as in candump.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from makes import Entry, Make, communication, eds_text, pdo, word

from canprobe.fieldbus.bus.virtual.lockstep import ALL_IDS
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.tools.faults import FaultyNode

MS = 1_000_000
REQUEST, ANSWER = 0x605, 0x585


class Changed(NamedTuple):
    can_id: int
    text: str


class DefectiveNode(FaultyNode):
    """The node and its defect.

    Attributes:
        starts: how often it got its power.
        last, before: identifier and data of the frame that it heard last, and of the one before.
        count: a counter for the defect.
    """

    def __init__(self, node: SlaveNode, hear: Any = None, say: Any = None) -> None:
        super().__init__(node)
        self._hear, self._say = hear, say
        self.last: tuple[int, str] = (0, "")
        self.before: tuple[int, str] = (0, "")
        self._heard = self.before
        self.count = self.t_ns = self.starts = 0
        self._delayed: list[tuple[int, Frame]] = []

    @property
    def listens(self) -> Any:
        return ALL_IDS

    @property
    def next_deadline_ns(self) -> int | None:
        due = [t for t in (self.node.next_deadline_ns, self._delayed[0][0] if self._delayed else None) if t is not None]
        return min(due, default=None)

    def number(self, index: int, subindex: int = 0) -> int:
        return self.node.dictionary.number(index, subindex)

    def later(self, after_ms: float, can_id: int, text: str) -> None:
        heapq.heappush(self._delayed, (self.t_ns + round(after_ms * MS), (can_id, bytes.fromhex(text))))

    def take(self, can_id: int, text: str) -> list[tuple[int, str]]:
        """Let the node take a frame; what it answers."""
        return [(i, data.hex()) for i, data in self.node.receive(can_id, bytes.fromhex(text), self.t_ns)]

    def start(self, t_ns: int) -> list[Frame]:
        self.t_ns, self.starts = t_ns, self.starts + 1
        return self._changed(self.node.start(t_ns))

    def receive(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        self.t_ns = t_ns
        self.before, self.last = self._heard, (can_id, data.hex())
        self._heard = self.last
        heard = self._hear(self, can_id, data.hex()) if self._hear is not None else None
        if isinstance(heard, Changed):
            can_id, data = heard.can_id, bytes.fromhex(heard.text)
        elif heard is not None:
            return [(answer_id, bytes.fromhex(text)) for answer_id, text in heard]
        return self._changed(self.node.receive(can_id, data, t_ns))

    def advance(self, t_ns: int) -> list[Frame]:
        self.t_ns = t_ns
        self.last = (0, "")
        out = list(self.node.advance(t_ns)) if (self.node.next_deadline_ns or t_ns + 1) <= t_ns else []
        out = self._changed(out)
        while self._delayed and self._delayed[0][0] <= t_ns:
            out.append(heapq.heappop(self._delayed)[1])
        return out

    def _changed(self, frames: Any) -> list[Frame]:
        if self._say is None:
            return list(frames)
        return [
            (can_id, bytes.fromhex(text))
            for frame in frames
            for can_id, text in self._say(self, frame[0], frame[1].hex())
        ]


Defect = Callable[[SlaveNode], DefectiveNode]


def hears(function: Any) -> Defect:
    return lambda node: DefectiveNode(node, hear=function)


def says(function: Any) -> Defect:
    return lambda node: DefectiveNode(node, say=function)


def answers(prefix: str, answer: str, *, when: Callable[[DefectiveNode], bool] = lambda device: True) -> Defect:
    """SDO requests that begin so are answered so, and do not reach the node."""

    def hear(device: DefectiveNode, can_id: int, text: str) -> Any:
        hit = can_id == REQUEST and text.startswith(prefix) and when(device)
        return [(ANSWER, answer.ljust(16, "0"))] if hit else None

    return hears(hear)


def accepts(prefix: str, *, when: Callable[[DefectiveNode], bool] = lambda device: True) -> Defect:
    """Writes that begin so are accepted and forgotten."""
    return answers(prefix, "60" + prefix[2:8], when=when)


def replaces(request: str, by: str) -> Defect:
    """An SDO request is taken for another one."""
    return hears(
        lambda device, can_id, text: (
            Changed(can_id, by.ljust(16, "0")) if can_id == REQUEST and text.startswith(request) else None
        )
    )


def rewrites(can_id: int, prefix: str, change: Callable[[str], str]) -> Defect:
    """What the node says under an identifier, where it begins so, is changed."""
    return says(
        lambda device, said_id, text: [
            (said_id, change(text) if said_id == can_id and text.startswith(prefix) else text)
        ]
    )


def drops(hit: Callable[[DefectiveNode, int, str], bool]) -> Defect:
    """Frames of the node that are lost."""
    return says(lambda device, can_id, text: [] if hit(device, can_id, text) else [(can_id, text)])


def whole_device() -> Make:
    """A device with every service of CiA 301 that the points examine."""
    objects = communication("0x12", "a name longer than seven", errors=8, consumers=2) | {
        (0x1007, 0): Entry("Synchronous window", "U32", "rw", 0),
        (0x100C, 0): Entry("Guard time", "U16", "rw", 0),
        (0x100D, 0): Entry("Life time factor", "U8", "rw", 0),
        (0x1029, 0): Entry("Highest sub-index", "U8", "ro", 1),
        (0x1029, 1): Entry("Communication error", "U8", "rw", 0),
        (0x1200, 0): Entry("Highest sub-index", "U8", "ro", 2),
        (0x1200, 1): Entry("Request", "U32", "ro", "$NODEID+0x600"),
        (0x1200, 2): Entry("Answer", "U32", "ro", "$NODEID+0x580"),
        (0x1201, 0): Entry("Highest sub-index", "U8", "ro", 3),
        (0x1201, 1): Entry("Request", "U32", "rw", "0x340"),
        (0x1201, 2): Entry("Answer", "U32", "rw", "0x3C0"),
        (0x1201, 3): Entry("Client", "U8", "rw", 0),
        (0x2001, 0): Entry("Value", "U32", "rw", 7, mappable=True),
        (0x2002, 0): Entry("Limited", "U16", "rw", 50, low=10, high=100),
        (0x2003, 0): Entry("Command", "U8", "wo", 0),
        (0x2004, 0): Entry("Byte", "U8", "ro", 1),
        (0x2005, 0): Entry("Measured", "U32", "ro", 5, mappable=True),
        (0x2006, 0): Entry("Target", "U32", "rww", 5, mappable=True),
    }
    for n in (1, 2):
        objects |= pdo("rpdo", n, (word(0x2006, 0, 32),), places=4)
        mapped = (word(0x2001, 0, 32), word(0x2005, 0, 32)) if n == 1 else (word(0x2005, 0, 32),)
        objects |= pdo("tpdo", n, mapped, places=4)
        objects[0x17FF + n, 6] = Entry("SYNC start value", "U8", "rw", 0)
    return Make("whole_device", 0x0200, objects=objects, lss=True)


def write_whole_device(folder: Path) -> Path:
    """Write its EDS; its sub-index 0 of the TPDOs counts the start value."""
    path = folder / "whole_device.eds"
    path.write_text(eds_text(whole_device()), encoding="ascii")
    return path
