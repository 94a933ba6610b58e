"""SDO abort codes, and the exception that carries one from an access to the server.

Source: CiA 301, table "SDO abort codes" (clause SDO abort transfer protocol).
"""

from __future__ import annotations

from enum import IntEnum

from canprobe.errors import ProtocolError


class Abort(IntEnum):
    """SDO abort codes with which a node here can answer."""

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
    HARDWARE = 0x06060000
    TOO_LONG = 0x06070012
    TOO_SHORT = 0x06070013
    NO_SUBINDEX = 0x06090011
    VALUE = 0x06090030
    VALUE_HIGH = 0x06090031
    VALUE_LOW = 0x06090032
    GENERAL = 0x08000000
    CANNOT_STORE = 0x08000020
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
