"""Layer setting services as bytes: identifiers, command specifiers, LSS addresses, and the table of bit rates.

Every message has eight bytes: the command specifier first, unused bytes 0.
Source: CiA 305, "LSS protocol specification".
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

LSS_REQUEST_ID = 0x7E5
"""Identifier of what the LSS master sends to all LSS slaves."""
LSS_ANSWER_ID = 0x7E4
"""Identifier of what an LSS slave sends to the LSS master."""
LSS_BYTES = 8
UNCONFIGURED_ID = 255
"""Node-ID FFh of a node without an id, which waits in initialisation for LSS."""
PRESENCE_CHECK = 0x80
"""Bit check of the fastscan question that every slave without an id answers; it starts the search again."""
BIT_RATES = {0: 1_000_000, 1: 800_000, 2: 500_000, 3: 250_000, 4: 125_000, 6: 50_000, 7: 20_000, 8: 10_000}
"""Bit rates by table index, bit/s, of table selector 0 of configure bit timing."""


class LssCommand(IntEnum):
    """Command specifiers, the first byte of a message."""

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
    """Pack a message into its eight bytes."""
    return (bytes((command,)) + data).ljust(LSS_BYTES, b"\0")


def pack_number(command: LssCommand, number: int) -> bytes:
    """Pack a message that carries one of the four numbers."""
    return pack_lss(command, number.to_bytes(4, "little"))


def pack_fastscan(number: int, bit: int, position: int, following: int) -> bytes:
    """Pack a question of fastscan.

    Args:
        number: the number that is looked for; its bits from `bit` upwards are compared.
        bit: lowest bit that is compared, 31 to 0, or `PRESENCE_CHECK`.
        position: which of the four numbers is asked for, 0 to 3.
        following: number that the slaves which answer expect next; one below `position` ends the search.
    """
    return pack_lss(LssCommand.FASTSCAN, number.to_bytes(4, "little") + bytes((bit, position, following)))
