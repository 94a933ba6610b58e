"""CAN frames, the identifiers of CiA 301, and the three services of a few bytes: NMT, heartbeat and SYNC."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum

from canprobe.errors import ProtocolError

Frame = tuple[int, bytes]
"""An 11-bit identifier and up to 8 data bytes."""

CLASSIC_BYTES = 8
"""Most data bytes of a classical CAN frame; a frame with more is one of CAN FD."""
BRS_FLAG = 0x01
"""Bit rate switch of a CAN FD frame, as in Linux's `struct canfd_frame`."""
EFF_FLAG = 0x80000000
"""Flag on a 29-bit identifier, as in Linux's `struct can_frame`."""
EFF_MASK = 0x1FFFFFFF
"""The bits of a 29-bit identifier."""

RTR_FLAG = 0x40000000
"""Flag on the identifier of a remote request, which has no data, as in Linux's `struct can_frame`."""

INVALID_FLAG = 1 << 31
"""Bit 31 of a COB-ID in the object dictionary: the PDO, SDO or EMCY does not exist."""

NMT_ID = 0x000
SYNC_ID = 0x080
EMCY_BASE = 0x080
SDO_TX_BASE = 0x580  # server (node) to client (master)
SDO_RX_BASE = 0x600  # client (master) to server (node)
HEARTBEAT_BASE = 0x700
MAX_SYNC_COUNT = 240
"""Highest counter of a SYNC. Source: CiA 301, object 1019h."""

# Source: CiA 301, table "restricted COB-IDs"; last row of CANopen's predefined set included.
_RESTRICTED_RANGES = (
    (0x000, 0x000),  # NMT
    (0x001, 0x07F),
    (0x101, 0x180),
    (0x581, 0x5FF),  # default SDO, server to client
    (0x601, 0x67F),  # default SDO, client to server
    (0x6E0, 0x6FF),
    (0x701, 0x77F),  # NMT error control
    (0x780, 0x7FF),
)
RESTRICTED_IDS = sorted({end for ends in _RESTRICTED_RANGES for end in ends})
"""The first and the last identifier of each restricted range: those to try."""


class NmtCommand(IntEnum):
    """NMT node control, first byte of the NMT frame. Source: CiA 301 (NMT protocols)."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET_NODE = 0x81
    RESET_COMMUNICATION = 0x82


class NmtState(IntEnum):
    """NMT state as the heartbeat reports it; INITIALISING is the boot-up message. Source: CiA 301."""

    INITIALISING = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


NMT_GOALS = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
    NmtCommand.RESET_NODE: NmtState.INITIALISING,
    NmtCommand.RESET_COMMUNICATION: NmtState.INITIALISING,
}
"""State to which each command leads, from every state but INITIALISING, in which none works; a slave leaves that for
PRE_OPERATIONAL by itself. Source: CiA 301, "NMT state machine" and "NMT node control".
"""


def _check_node(node_id: int, lowest: int = 1) -> int:
    if not lowest <= node_id <= 127:
        raise ProtocolError(f"node id {node_id}: must be {lowest}..127")
    return node_id


def pack_nmt(command: NmtCommand, node_id: int = 0) -> Frame:
    """Pack an NMT command for one node, or for all with node id 0.

    Raises:
        ProtocolError: the node id is not 0..127.
    """
    return NMT_ID, bytes((command, _check_node(node_id, lowest=0)))


def pack_heartbeat(node_id: int, state: NmtState) -> Frame:
    """Pack the heartbeat of a node; with INITIALISING it is the boot-up message.

    Raises:
        ProtocolError: the node id is not 1..127.
    """
    return HEARTBEAT_BASE + _check_node(node_id), bytes((state,))


def unpack_heartbeat(data: bytes) -> NmtState:
    """Unpack the state from a heartbeat, boot-up or node-guarding answer (whose toggle bit 7 is dropped).

    Raises:
        ProtocolError: the data are not one byte, or the byte is no NMT state.
    """
    if len(data) != 1:
        raise ProtocolError(f"heartbeat: expected 1 byte, got {len(data)}")
    try:
        return NmtState(data[0] & 0x7F)
    except ValueError:
        raise ProtocolError(f"heartbeat: unknown state {data[0]:#04x}") from None


def is_restricted(cob_id: int) -> bool:
    """Whether CiA 301 forbids an 11-bit identifier to PDOs, SYNC, EMCY and additional SDOs.

    080h itself (SYNC) and the bases 580h and 600h are not in the standard's table.
    """
    return any(first <= cob_id <= last for first, last in _RESTRICTED_RANGES)


class SyncCounter:
    """Counts SYNC messages 1, 2, … overflow, 1, … as its producer sends them: empty frames, or frames of one byte.

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
