"""How much of a bus a PDO takes: a classical frame, or above 8 bytes one of CAN FD with bit-rate switch."""

from __future__ import annotations

from canprobe.protocol.frame_bits import worst_case_bits, worst_case_fd_bits
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
    worst = worst_case_fd_bits(n_data)
    return worst.nominal - (-worst.data * bus.bitrate // bus.data_bitrate)
