"""How much of a bus a PDO takes: a classical frame, or above 8 bytes one of CAN FD with bit-rate switch."""

from __future__ import annotations

from canprobe.protocol.frame_bits import (
    FrameLength,
    best_case_bits,
    best_case_fd_bits,
    exact_bits,
    exact_fd_bits,
    worst_case_bits,
    worst_case_fd_bits,
)
from canprobe.scene import BusSettings

CLASSIC_BYTES = 8


def frame_bits(n_data: int, bus: BusSettings) -> int:
    """Worst case of one frame in bit times of the nominal rate; the data phase of an FD frame rounded up.

    Args:
        n_data: data bytes.
        bus: its two bit rates.
    """
    if n_data <= CLASSIC_BYTES:
        return worst_case_bits(n_data)
    return _nominal(worst_case_fd_bits(n_data), bus)


def shortest_bits(n_data: int, bus: BusSettings) -> int:
    """The same without one stuff bit that depends on the data."""
    return best_case_bits(n_data) if n_data <= CLASSIC_BYTES else _nominal(best_case_fd_bits(n_data), bus)


def exact_frame_bits(can_id: int, data: bytes, bus: BusSettings) -> int:
    """The same of this very frame."""
    return exact_bits(can_id, data) if len(data) <= CLASSIC_BYTES else _nominal(exact_fd_bits(can_id, data), bus)


def _nominal(length: FrameLength, bus: BusSettings) -> int:
    return length.nominal - (-length.data * bus.bitrate // bus.data_bitrate)
