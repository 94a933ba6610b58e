"""SDO frames: requests packed, and what stands where in requests and answers. Source: CiA 301, "SDO protocols"."""

from __future__ import annotations

ABORT = 0x80
"""Command byte of an abort, from either side."""
MAX_EXPEDITED_BYTES = 4
_READ = 0x40
_SIZE_FLAG = 0x01
Place = tuple[int, int]
"""Index and sub-index of an entry."""


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
