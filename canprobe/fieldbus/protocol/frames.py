"""CAN frames, the identifiers of CiA 301, and the services of a few bytes: NMT, heartbeat, SYNC, EMCY and LSS."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

from canprobe.errors import ProtocolError

Frame = tuple[int, bytes]
"""An 11-bit identifier and up to 8 data bytes."""

EFF_FLAG = 0x80000000
"""On a 29-bit identifier, as in Linux's `struct can_frame`."""

RTR_FLAG = 0x40000000
"""On the identifier of a remote request (which has no data), as in Linux's `struct can_frame`."""

NMT_ID = 0x000
SYNC_ID = 0x080
EMCY_BASE = 0x080
SDO_TX_BASE = 0x580  # server (node) to client (master)
SDO_RX_BASE = 0x600  # client (master) to server (node)
HEARTBEAT_BASE = 0x700

# Source: CiA 301, table "restricted COB-IDs"; last row of CANopen's predefined set included.
_RESTRICTED = (
    (0x000, 0x000),  # NMT
    (0x001, 0x07F),
    (0x101, 0x180),
    (0x581, 0x5FF),  # default SDO, server to client
    (0x601, 0x67F),  # default SDO, client to server
    (0x6E0, 0x6FF),
    (0x701, 0x77F),  # NMT error control
    (0x780, 0x7FF),
)


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
        ProtocolError: not one byte, or no NMT state.
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
    return any(first <= cob_id <= last for first, last in _RESTRICTED)


# The SYNC object: an empty frame, or one byte that counts 1..overflow (1019h).


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
        if overflow != 0 and not 2 <= overflow <= 240:
            raise ProtocolError(f"SYNC counter overflow {overflow}: must be 0 or 2..240 (1019h)")
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
    """Whether a frame is a SYNC: 080h without data, or with its counter."""
    return can_id == SYNC_ID and len(data) <= 1


def long_syncs_text(lengths: Mapping[int, int]) -> str:
    """What is said of 080h with more data than a SYNC has; empty without any.

    Args:
        lengths: how many such frames there are of each length, bytes.
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
    if not 1 <= counter <= 240:
        raise ProtocolError(f"SYNC counter {counter}: must be 1..240")
    return SYNC_ID, bytes((counter,))


# Emergency messages: pack, unpack, and the words for their codes.

_FORM = struct.Struct("<HB5s")

NO_ERROR = 0x0000
"""What a node sends when an error is over."""
HEARTBEAT_LOST = 0x8130
SYNC_LOST = 0x8100
PDO_TOO_SHORT = 0x8210
PDO_TOO_LONG = 0x8220
SYNC_LENGTH = 0x8240
RPDO_TIMEOUT = 0x8250
FOLLOWING_ERROR = 0x8611
REFERENCE_LIMIT = 0x8612

# Longest match wins: the code itself, then with its last digit, last two and last three digits cleared.
# Source: CiA 301 (emergency error codes) and CiA 402-2 (error codes of drives).
_WORDS = {
    0x0000: "error reset, no error",
    0x1000: "generic error",
    0x2000: "current",
    0x2300: "current at the device's output",
    0x2310: "continuous over-current",
    0x2320: "short circuit or earth leakage",
    0x3000: "voltage",
    0x3100: "mains voltage",
    0x3200: "voltage inside the device",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x4000: "temperature",
    0x4200: "device temperature",
    0x4210: "device over-temperature",
    0x4300: "drive temperature",
    0x4310: "drive over-temperature",
    0x5000: "device hardware",
    0x5530: "non-volatile memory",
    0x6000: "device software",
    0x6300: "data set",
    0x6320: "parameter error",
    0x7000: "additional module",
    0x7120: "motor",
    0x7121: "motor blocked",
    0x7300: "sensor",
    0x7305: "incremental sensor 1",
    0x8000: "monitoring",
    0x8100: "communication",
    0x8110: "CAN overrun, objects lost",
    0x8120: "CAN in error passive mode",
    0x8130: "life guard or heartbeat error",
    0x8140: "recovered from bus off",
    0x8150: "CAN-ID collision",
    0x8200: "protocol error",
    0x8210: "PDO not processed due to length error",
    0x8220: "PDO length exceeded",
    0x8230: "destination object not available",
    0x8240: "unexpected SYNC data length",
    0x8250: "RPDO time-out",
    0x8400: "velocity control",
    0x8480: "velocity following error",
    0x8500: "position control",
    0x8600: "positioning",
    0x8611: "following error",
    0x8612: "reference limit",
    0x9000: "external error",
    0xF000: "additional functions",
    0xFF00: "device specific",
}
_MASKS = (0xFFFF, 0xFFF0, 0xFF00, 0xF000)


@dataclass(frozen=True, slots=True)
class Emcy:
    """One emergency message.

    Attributes:
        code: emergency error code; 0000h is "error reset".
        register: the error register 1001h after the event.
        data: five manufacturer-specific bytes (shorter data is filled with zeros).
    """

    code: int
    register: int
    data: bytes = bytes(5)

    def pack(self) -> bytes:
        """Pack into the 8 bytes of the wire.

        Raises:
            ProtocolError: a field that does not fit.
        """
        if len(self.data) > 5:
            raise ProtocolError(f"EMCY: at most 5 manufacturer bytes, got {len(self.data)}")
        try:
            return _FORM.pack(self.code, self.register, self.data)
        except struct.error as error:
            raise ProtocolError(f"EMCY: {error}") from None

    @classmethod
    def unpack(cls, data: bytes) -> Emcy:
        """Unpack exactly 8 bytes.

        Raises:
            ProtocolError: another length.
        """
        if len(data) != 8:
            raise ProtocolError(f"EMCY: expected 8 bytes, got {len(data)}")
        return cls(*_FORM.unpack(data))

    def frame(self, node_id: int) -> Frame:
        """The frame on the predefined identifier 080h + node id."""
        return EMCY_BASE + node_id, self.pack()


def is_no_error(code: int) -> bool:
    """Whether an emergency error code reports no error. Source: CiA 301, emergency error codes, 00xxh."""
    return code >> 8 == 0


def describe(code: int) -> str:
    """An emergency error code in words: the most specific entry of CiA 301 or CiA 402 that covers it."""
    if is_no_error(code):
        return _WORDS[NO_ERROR]
    for mask in _MASKS:
        words = _WORDS.get(code & mask)
        if words is not None and code & mask:
            return words
    return f"unknown emergency code {code:04X}h"


# Layer setting services as bytes: identifiers, command specifiers, LSS addresses, and the table of bit rates.
#
# Every message has eight bytes: the command specifier first, unused bytes 0.
# Source: CiA 305, "LSS protocol specification".

LSS_REQUEST_ID = 0x7E5
"""LSS master to all LSS slaves."""
LSS_ANSWER_ID = 0x7E4
"""An LSS slave to the LSS master."""
LSS_LENGTH = 8
UNCONFIGURED = 255
"""Node-ID FFh: the node has none and waits in initialisation for LSS."""
NOTHING_ASKED = 0x80
"""Bit check of fastscan that asks who is there at all and starts the search again."""
BIT_RATES = {0: 1_000_000, 1: 800_000, 2: 500_000, 3: 250_000, 4: 125_000, 6: 50_000, 7: 20_000, 8: 10_000}
"""Table selector 0 of configure bit timing: index → bit/s."""


class LssCommand(IntEnum):
    """Command specifiers."""

    SWITCH_GLOBAL = 0x04
    CONFIGURE_NODE_ID = 0x11
    CONFIGURE_BIT_TIMING = 0x13
    ACTIVATE_BIT_TIMING = 0x15
    STORE = 0x17
    SELECT_VENDOR = 0x40
    SELECT_PRODUCT = 0x41
    SELECT_REVISION = 0x42
    SELECT_SERIAL = 0x43
    SELECTED = 0x44
    IDENTIFY_VENDOR = 0x46
    IDENTIFY_PRODUCT = 0x47
    IDENTIFY_REVISION_LOW = 0x48
    IDENTIFY_REVISION_HIGH = 0x49
    IDENTIFY_SERIAL_LOW = 0x4A
    IDENTIFY_SERIAL_HIGH = 0x4B
    IDENTIFY_UNCONFIGURED = 0x4C
    IDENTIFIED = 0x4F
    IDENTIFIED_UNCONFIGURED = 0x50
    FASTSCAN = 0x51
    INQUIRE_VENDOR = 0x5A
    INQUIRE_PRODUCT = 0x5B
    INQUIRE_REVISION = 0x5C
    INQUIRE_SERIAL = 0x5D
    INQUIRE_NODE_ID = 0x5E


class LssState(IntEnum):
    """State of an LSS slave, as switch state global sets it."""

    WAITING = 0
    CONFIGURATION = 1


class LssError(IntEnum):
    """Error codes of configure node-ID, configure bit timing and store configuration."""

    NONE = 0
    REFUSED = 1  # out of range; bit timing not supported; storing not supported
    STORE_FAILED = 2


@dataclass(frozen=True, slots=True, order=True)
class LssAddress:
    """The 128 bits that identify a device in the world: object 1018h."""

    vendor_id: int
    product_code: int
    revision_number: int
    serial_number: int

    @property
    def numbers(self) -> tuple[int, int, int, int]:
        """The four numbers, as 1018h:01 to :04."""
        return self.vendor_id, self.product_code, self.revision_number, self.serial_number

    def __str__(self) -> str:
        return ":".join(f"{number:#x}" for number in self.numbers)


def pack_lss(command: LssCommand, data: bytes = b"") -> bytes:
    """The eight bytes of a message."""
    return (bytes((command,)) + data).ljust(LSS_LENGTH, b"\0")


def pack_number(command: LssCommand, number: int) -> bytes:
    """A message that carries one of the four numbers."""
    return pack_lss(command, number.to_bytes(4, "little"))


def pack_fastscan(number: int, bit: int, position: int, following: int) -> bytes:
    """A question of fastscan.

    Args:
        number: bits from `bit` upwards are compared.
        bit: 31 to 0, or `NOTHING_ASKED`.
        position: which of the four numbers is asked for, 0 to 3.
        following: which one those that answer expect next; one below `position` ends the search.
    """
    return pack_lss(LssCommand.FASTSCAN, number.to_bytes(4, "little") + bytes((bit, position, following)))
