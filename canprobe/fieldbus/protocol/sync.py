"""The SYNC object: an empty frame, or one byte that counts 1..overflow (1019h)."""

from __future__ import annotations

from collections.abc import Mapping

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.frames import SYNC_ID, Frame

MAX_SYNC_COUNT = 240
"""Highest counter of a SYNC. Source: CiA 301, object 1019h."""


class SyncCounter:
    """Counts SYNC messages 1, 2, … overflow, 1, … as its producer sends them.

    Overflow 0 means SYNC without a counter; 1 and 241..255 are reserved.
    Source: CiA 301, object 1019h (synchronous counter overflow value).
    """

    __slots__ = ("_value", "overflow")

    def __init__(self, overflow: int) -> None:
        """Start before the first SYNC.

        Raises:
            ProtocolError: the overflow is not 0 or 2..240.
        """
        if overflow != 0 and not 2 <= overflow <= MAX_SYNC_COUNT:
            raise ProtocolError(f"SYNC counter overflow {overflow}: must be 0 or 2..{MAX_SYNC_COUNT} (1019h)")
        self.overflow = overflow
        self._value = 0

    def next(self) -> int | None:
        """Advance and return the counter of the next SYNC; None when SYNC has no counter."""
        if self.overflow == 0:
            return None
        self._value = self._value % self.overflow + 1
        return self._value

    def reset(self) -> None:
        """Start again at 1, as a producer does when it enters operation."""
        self._value = 0


def is_sync(can_id: int, data: bytes) -> bool:
    """Whether a frame is a SYNC: identifier 080h, without data or with the counter."""
    return can_id == SYNC_ID and len(data) <= 1


def long_syncs_text(lengths: Mapping[int, int]) -> str:
    """Words for frames 080h with more data than a SYNC has; empty where there are none.

    Args:
        lengths: number of such frames by their length in bytes.
    """
    each = ", ".join(f"{count} frames 080h of {length} bytes" for length, count in sorted(lengths.items()))
    return each and f"{each}, which CiA 301 does not know"


def pack_sync(counter: int | None = None) -> Frame:
    """Pack a SYNC on the default identifier 080h, with its counter unless that is None.

    Raises:
        ProtocolError: the counter is not 1..240.
    """
    if counter is None:
        return SYNC_ID, b""
    if not 1 <= counter <= MAX_SYNC_COUNT:
        raise ProtocolError(f"SYNC counter {counter}: must be 1..{MAX_SYNC_COUNT}")
    return SYNC_ID, bytes((counter,))
