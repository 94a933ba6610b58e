"""A frame that was seen on a bus, and the frames of a log, which is judged after the fact."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from heapq import heappop, heappush
from pathlib import Path

from canprobe.errors import UsageError
from canprobe.fieldbus.bus.logs import open_log
from canprobe.fieldbus.bus.port import ERR_FLAG
from canprobe.fieldbus.protocol.frames import EFF_FLAG, EFF_MASK, EMCY_BASE, HEARTBEAT_BASE, RTR_FLAG, SDO_TX_BASE

_SENT_BY_NODES = (EMCY_BASE, SDO_TX_BASE, HEARTBEAT_BASE)
_OUT_OF_ORDER = 1000
"""Lines by which a frame may stand too late in a log."""


@dataclass(frozen=True, slots=True)
class BusFrame:
    """A frame that was seen.

    Attributes:
        t_ns: time on the clock of the bus or its log.
        can_id: identifier with the flags of `protocol.frames`.
        data: data bytes.
        from_node: whether a node that is served here has sent it; None in a log, which does not have it.
    """

    t_ns: int
    can_id: int
    data: bytes
    from_node: bool | None = None

    def __str__(self) -> str:
        name = f"{self.can_id & EFF_MASK:08X}" if self.can_id & EFF_FLAG else f"{self.can_id & 0x7FF:03X}"
        return f"({self.t_ns * 1e-9:.6f}) {name}#{'R' if self.can_id & RTR_FLAG else self.data.hex().upper()}"


def read_record(path: Path, channel: str | None = None) -> Iterator[BusFrame]:
    """Read the frames of one channel of a log in the order of their times; error frames are left out.

    A log that was written by a master has the frames that it sent before those that it read later.

    Args:
        path: path of the log.
        channel: channel; None where the log has only one.

    Raises:
        UsageError: the file is no log, it has several channels and none is named, or not the one that is named.
    """
    waiting: list[tuple[int, int, BusFrame]] = []
    for number, frame in enumerate(_frames(path, channel)):
        heappush(waiting, (frame.t_ns, number, frame))
        if len(waiting) > _OUT_OF_ORDER:
            yield heappop(waiting)[2]
    while waiting:
        yield heappop(waiting)[2]


def nodes_of(frames: Iterable[BusFrame]) -> tuple[int, ...]:
    """Ids of the nodes that frames show: those that send a heartbeat, a boot-up, an EMCY or an SDO answer."""
    ids = {frame.can_id & 0x7F for frame in frames if frame.can_id & ~0x7F in _SENT_BY_NODES}
    return tuple(sorted(ids - {0}))


def _frames(path: Path, channel: str | None) -> Iterator[BusFrame]:
    seen: set[str] = set()
    for t_ns, on, can_id, data in open_log(path):
        seen.add(on)
        if channel is None and len(seen) > 1:
            names = " and ".join(sorted(seen))
            raise UsageError(f"{path}: the log has the channels {names}; choose one: --channel {on}")
        if channel in (None, on) and not (can_id & ERR_FLAG and not can_id & EFF_FLAG):
            yield BusFrame(t_ns, can_id, data)
    if not seen:
        raise UsageError(f"{path}: the log has no frames")
    if channel is not None and channel not in seen:
        raise UsageError(f"{path}: the log has no channel {channel}, only {', '.join(sorted(seen))}")
