"""How much of a bus a PDO takes: a classical frame, or above 8 bytes one of CAN FD with bit-rate switch."""

from __future__ import annotations

from canprobe.protocol.frame_bits import (
    best_case_bits,
    best_case_fd_bits,
    exact_bits,
    exact_fd_bits,
    worst_case_bits,
    worst_case_fd_bits,
)
from canprobe.scene_setup import Bus

CLASSIC_BYTES = 8


def frame_bits(n_data: int, bus: Bus) -> int:
    """Worst case of one frame in bit times of the nominal rate; the data phase of an FD frame rounded up.

    Args:
        n_data: data bytes.
        bus: its two bit rates.
    """
    if n_data <= CLASSIC_BYTES:
        return worst_case_bits(n_data)
    worst = worst_case_fd_bits(n_data)
    return worst.nominal - (-worst.data * bus.bitrate // bus.data_bitrate)


def exact_frame_bits(can_id: int, data: bytes, bus: Bus) -> int:
    """Bits of this very frame, in the same bit times."""
    if len(data) <= CLASSIC_BYTES:
        return exact_bits(can_id, data)
    exact = exact_fd_bits(can_id, data)
    return exact.nominal - (-exact.data * bus.bitrate // bus.data_bitrate)


def unstuffed_frame_bits(n_data: int, bus: Bus) -> int:
    """Bits of a frame without stuff bits, as `canbusload -i` counts, in the same bit times."""
    if n_data <= CLASSIC_BYTES:
        return best_case_bits(n_data)
    best = best_case_fd_bits(n_data)
    return best.nominal - (-best.data * bus.bitrate // bus.data_bitrate)
