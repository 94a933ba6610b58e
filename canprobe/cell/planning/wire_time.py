"""Bits of a PDO on the wire, as a classical frame or, above 8 bytes, as one of CAN FD with bit-rate switch.

Times are bit times of the nominal rate; the data phase of an FD frame is rounded up.
"""

from __future__ import annotations

from canprobe.cell.scene.hardware import BusSettings
from canprobe.fieldbus.protocol.frame_bits import (
    FrameLength,
    best_case_bits,
    best_case_fd_bits,
    exact_bits,
    exact_fd_bits,
    worst_case_bits,
    worst_case_fd_bits,
)
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES


def frame_bits(n_data: int, bus: BusSettings) -> int:
    """Most bits of one frame with a number of data bytes."""
    return worst_case_bits(n_data) if n_data <= CLASSIC_BYTES else _nominal(worst_case_fd_bits(n_data), bus)


def exact_frame_bits(can_id: int, data: bytes, bus: BusSettings) -> int:
    """Bits of one frame, its stuff bits included."""
    return exact_bits(can_id, data) if len(data) <= CLASSIC_BYTES else _nominal(exact_fd_bits(can_id, data), bus)


def unstuffed_frame_bits(n_data: int, bus: BusSettings) -> int:
    """Bits of a frame without stuff bits, as `canbusload -i` counts."""
    return best_case_bits(n_data) if n_data <= CLASSIC_BYTES else _nominal(best_case_fd_bits(n_data), bus)


def _nominal(length: FrameLength, bus: BusSettings) -> int:
    return length.nominal - (-length.data * bus.bitrate // bus.data_bitrate)
