"""Emergency messages: pack, unpack, and the words for their codes."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from canprobe.errors import ProtocolError

_FORM = struct.Struct("<HB5s")
NO_ERROR_CODE = 0x0000
"""Code that a node sends when an error is over."""
HEARTBEAT_LOST_CODE = 0x8130
SYNC_LOST_CODE = 0x8100
PDO_TOO_SHORT_CODE = 0x8210
PDO_TOO_LONG_CODE = 0x8220
SYNC_LENGTH_CODE = 0x8240
RPDO_TIMEOUT_CODE = 0x8250
FOLLOWING_ERROR_CODE = 0x8611
REFERENCE_LIMIT_CODE = 0x8612
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
_CODE_MASKS = (0xFFFF, 0xFFF0, 0xFF00, 0xF000)


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
            ProtocolError: a field does not fit.
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
            ProtocolError: the data have another length.
        """
        if len(data) != 8:
            raise ProtocolError(f"EMCY: expected 8 bytes, got {len(data)}")
        return cls(*_FORM.unpack(data))


def is_no_error(code: int) -> bool:
    """Whether an emergency error code reports no error. Source: CiA 301, emergency error codes, 00xxh."""
    return code >> 8 == 0


def describe(code: int) -> str:
    """An emergency error code in words: the most specific entry of CiA 301 or CiA 402 that covers it."""
    if is_no_error(code):
        return _WORDS[NO_ERROR_CODE]
    for mask in _CODE_MASKS:
        words = _WORDS.get(code & mask)
        if words is not None and code & mask:
            return words
    return f"unknown emergency code {code:04X}h"
