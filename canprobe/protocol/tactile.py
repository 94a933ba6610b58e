"""Tactile frames: what they are on the wire, and their reassembly.

The wire form is written down in `tactile_wire`, the rules of reassembly in `tactile_assembler`.
"""

from canprobe.protocol.tactile_assembler import FrameAssembler, TactileFrame
from canprobe.protocol.tactile_wire import (
    PDO_COUNT,
    SIDE,
    WINDOW,
    WINDOWS,
    Features,
    TactileHeader,
    TactileMode,
    crc16_ccitt,
    pack_frame,
    pack_whole,
    pdo_count,
    window_words,
)

__all__ = [
    "PDO_COUNT",
    "SIDE",
    "WINDOW",
    "WINDOWS",
    "Features",
    "FrameAssembler",
    "TactileFrame",
    "TactileHeader",
    "TactileMode",
    "crc16_ccitt",
    "pack_frame",
    "pack_whole",
    "pdo_count",
    "window_words",
]
