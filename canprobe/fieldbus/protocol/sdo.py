"""SDO frames: requests packed, what stands where in requests and answers, and abort codes.

Source: CiA 301, "SDO protocols", table "SDO abort codes".
"""

from __future__ import annotations

from enum import IntEnum

from canprobe.errors import ProtocolError

ABORT = 0x80
"""Command byte of an abort, from either side."""
MAX_EXPEDITED_BYTES = 4
_READ = 0x40
_SIZE_FLAG = 0x01
Place = tuple[int, int]
"""Index and sub-index of an entry."""


class Abort(IntEnum):
    """SDO abort codes."""

    TOGGLE = 0x05030000
    TIMED_OUT = 0x05040000
    COMMAND = 0x05040001
    BLOCK_SIZE = 0x05040002
    SEQUENCE = 0x05040003
    CRC = 0x05040004
    MEMORY = 0x05040005
    UNSUPPORTED_ACCESS = 0x06010000
    WRITE_ONLY = 0x06010001
    READ_ONLY = 0x06010002
    NO_OBJECT = 0x06020000
    NOT_MAPPABLE = 0x06040041
    MAPPING_LENGTH = 0x06040042
    PARAMETER_INCOMPATIBLE = 0x06040043
    INTERNAL_INCOMPATIBILITY = 0x06040047
    HARDWARE = 0x06060000
    LENGTH_DOES_NOT_MATCH = 0x06070010
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE = 0x06090030
    VALUE_HIGH = 0x06090031
    VALUE_LOW = 0x06090032
    MAXIMUM_BELOW_MINIMUM = 0x06090036
    RESOURCE_NOT_AVAILABLE = 0x060A0023
    GENERAL = 0x08000000
    CANNOT_STORE = 0x08000020
    LOCAL_CONTROL_PREVENTS_IT = 0x08000021
    DEVICE_STATE = 0x08000022
    NO_DATA = 0x08000024


class SdoAbort(ProtocolError):  # noqa: N818 - the standard's word
    """The dictionary or the server refuses an access.

    Attributes:
        code: abort code that goes to the client.
    """

    def __init__(self, code: Abort) -> None:
        self.code = code
        super().__init__(f"{code.name.lower().replace('_', ' ')} ({code:08X}h)")


def pack_request(command: int, index: int, subindex: int = 0, data: bytes = b"") -> bytes:
    """Pack command byte, multiplexer, and up to four bytes."""
    return bytes((command,)) + index.to_bytes(2, "little") + bytes((subindex,)) + data.ljust(4, b"\0")


def pack_read(index: int, subindex: int = 0) -> bytes:
    """Pack the request for an upload."""
    return pack_request(_READ, index, subindex)


def pack_write(index: int, subindex: int, value: bytes) -> bytes:
    """Pack an expedited download of one to four bytes."""
    return pack_request(0x23 | (MAX_EXPEDITED_BYTES - len(value)) << 2, index, subindex, value)


def pack_abort(index: int, subindex: int, code: int) -> bytes:
    """Pack an abort with its code."""
    return pack_request(ABORT, index, subindex, code.to_bytes(4, "little"))


def place_of(data: bytes) -> Place:
    """Index and sub-index in a frame; what a short frame leaves out is 0."""
    return int.from_bytes(data[1:3], "little"), data[3] if len(data) > 3 else 0


def place_text(index: int, subindex: int) -> str:
    """An index and a sub-index as the standard writes them, such as 1600h:01."""
    return f"{index:04X}h:{subindex:02X}"


def abort_code(data: bytes) -> int:
    """Code of an abort."""
    return int.from_bytes(data[4:8], "little")


def stated_size(data: bytes) -> int | None:
    """Number of bytes that the beginning of a segmented transfer announces; None where it announces none."""
    return int.from_bytes(data[4:8], "little") if data[0] & _SIZE_FLAG else None


def expedited_value(data: bytes, size: int = MAX_EXPEDITED_BYTES) -> bytes:
    """Value in an expedited frame; `size` bytes where it does not state how many of its four it uses."""
    return data[4 : 8 - (data[0] >> 2 & 3)] if data[0] & _SIZE_FLAG else data[4 : 4 + size]


def segment_value(data: bytes) -> bytes:
    """Bytes in a segment."""
    return data[1 : 8 - (data[0] >> 1 & 7)]
