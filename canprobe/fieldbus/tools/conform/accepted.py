"""Abort codes that each refusal may have, and abort codes in words.

The first code of a set is the most exact one. The others are those that the conformance test of CiA accepts, too; a
device that answers with one of them passes, and the report notes the code.
Source: CiA 301, table "SDO abort codes"; CANopenDemo, test/test_report_CCT.md (sets of the CiA test tool 3.0.3).
"""

from __future__ import annotations

from canprobe.fieldbus.protocol.sdo import Abort

AbortSet = tuple[int, ...]
"""Accepted codes, the most exact one first."""

READ_ONLY = (Abort.READ_ONLY, Abort.UNSUPPORTED_ACCESS, Abort.GENERAL)
WRITE_ONLY = (Abort.WRITE_ONLY, Abort.UNSUPPORTED_ACCESS, Abort.GENERAL)
NO_OBJECT = (Abort.NO_OBJECT, Abort.GENERAL)
NO_SUBINDEX = (Abort.NO_SUBINDEX, Abort.GENERAL)
NO_ENTRY = (Abort.NO_SUBINDEX, Abort.NO_OBJECT, Abort.GENERAL)
UNKNOWN_COMMAND = (Abort.COMMAND, Abort.GENERAL)
TOO_LONG = (Abort.TOO_LONG, Abort.LENGTH_DOES_NOT_MATCH, Abort.GENERAL)
TOO_SHORT = (Abort.TOO_SHORT, Abort.LENGTH_DOES_NOT_MATCH, Abort.GENERAL)
ABOVE = (Abort.VALUE_HIGH, Abort.VALUE, Abort.GENERAL)
BELOW = (Abort.VALUE_LOW, Abort.VALUE, Abort.GENERAL)
TOGGLE = (Abort.TOGGLE, Abort.GENERAL)
TIMED_OUT = (Abort.TIMED_OUT,)
BLOCK_SIZE = (Abort.BLOCK_SIZE, Abort.COMMAND, Abort.GENERAL)
SEQUENCE = (Abort.SEQUENCE, Abort.COMMAND, Abort.GENERAL)
CRC = (Abort.CRC, Abort.COMMAND, Abort.GENERAL)
MAPPING_LOCKED = (Abort.UNSUPPORTED_ACCESS, Abort.NOT_MAPPABLE, Abort.DEVICE_STATE, Abort.GENERAL)
MAPPING_LENGTH = (Abort.MAPPING_LENGTH, Abort.NOT_MAPPABLE, Abort.UNSUPPORTED_ACCESS, Abort.NO_OBJECT, Abort.GENERAL)
NOT_MAPPABLE = (Abort.NOT_MAPPABLE, Abort.NO_OBJECT, Abort.UNSUPPORTED_ACCESS, Abort.GENERAL)
PDO_LOCKED = (Abort.VALUE, Abort.UNSUPPORTED_ACCESS, Abort.DEVICE_STATE, Abort.GENERAL)
VALUE = (Abort.VALUE, Abort.VALUE_HIGH, Abort.VALUE_LOW, Abort.GENERAL)
SYNC_LOCKED = (Abort.DEVICE_STATE, Abort.GENERAL)
DUPLICATE = (Abort.PARAMETER_INCOMPATIBLE, Abort.VALUE, Abort.GENERAL)
NO_DATA = (Abort.NO_DATA, Abort.GENERAL)


def abort_text(code: int) -> str:
    """An abort code with its words."""
    words = Abort(code).name.lower().replace("_", " ") if code in tuple(Abort) else "unknown code"
    return f"{code:08X}h ({words})"


def text(accepted: AbortSet) -> str:
    """The accepted codes as text."""
    return "abort " + ", ".join(f"{code:08X}h" for code in accepted)
