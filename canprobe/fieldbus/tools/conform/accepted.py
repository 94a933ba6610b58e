"""Abort codes that each refusal may have, and abort codes in words.

The first code of a set is the most exact one. The others are those that the conformance test of CiA accepts, too; a
device that answers with one of them passes, and the report notes the code.
Source: CiA 301, table "SDO abort codes"; CANopenDemo, test/test_report_CCT.md (sets of the CiA test tool 3.0.3).
"""

from __future__ import annotations

from canprobe.fieldbus.node.abort import Abort

AbortSet = tuple[int, ...]
"""Accepted codes, the most exact one first."""

_GENERAL = 0x08000000
READ_ONLY: AbortSet = (0x06010002, 0x06010000, _GENERAL)
WRITE_ONLY: AbortSet = (0x06010001, 0x06010000, _GENERAL)
NO_OBJECT: AbortSet = (0x06020000, _GENERAL)
NO_SUBINDEX: AbortSet = (0x06090011, _GENERAL)
NO_ENTRY: AbortSet = (0x06090011, 0x06020000, _GENERAL)
UNKNOWN_COMMAND: AbortSet = (0x05040001, _GENERAL)
TOO_LONG: AbortSet = (0x06070012, 0x06070010, _GENERAL)
TOO_SHORT: AbortSet = (0x06070013, 0x06070010, _GENERAL)
ABOVE: AbortSet = (0x06090031, 0x06090030, _GENERAL)
BELOW: AbortSet = (0x06090032, 0x06090030, _GENERAL)
TOGGLE: AbortSet = (0x05030000, _GENERAL)
TIMED_OUT: AbortSet = (0x05040000,)
BLOCK_SIZE: AbortSet = (0x05040002, 0x05040001, _GENERAL)
SEQUENCE: AbortSet = (0x05040003, 0x05040001, _GENERAL)
CRC: AbortSet = (0x05040004, 0x05040001, _GENERAL)
MAPPING_LOCKED: AbortSet = (0x06010000, 0x06040041, 0x08000022, _GENERAL)
MAPPING_LENGTH: AbortSet = (0x06040042, 0x06040041, 0x06010000, 0x06020000, _GENERAL)
NOT_MAPPABLE: AbortSet = (0x06040041, 0x06020000, 0x06010000, _GENERAL)
PDO_LOCKED: AbortSet = (0x06090030, 0x06010000, 0x08000022, _GENERAL)
VALUE: AbortSet = (0x06090030, 0x06090031, 0x06090032, _GENERAL)
SYNC_LOCKED: AbortSet = (0x08000022, _GENERAL)
DUPLICATE: AbortSet = (0x06040043, 0x06090030, _GENERAL)
NO_DATA: AbortSet = (0x08000024, _GENERAL)

_WORDS = {
    0x06040047: "internal incompatibility",
    0x06070010: "length does not match",
    0x06090023: "sub-index does not exist",
    0x06090036: "maximum below minimum",
    0x060A0023: "resource not available",
    0x08000021: "local control prevents it",
}


def abort_text(code: int) -> str:
    """An abort code with its words."""
    words = _WORDS.get(code) or (Abort(code).name.lower().replace("_", " ") if code in tuple(Abort) else "unknown code")
    return f"{code:08X}h ({words})"


def text(accepted: AbortSet) -> str:
    """The accepted codes as text."""
    return "abort " + ", ".join(f"{code:08X}h" for code in accepted)
