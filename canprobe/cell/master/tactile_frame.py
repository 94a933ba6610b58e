"""A tactile frame as controllers see it: the taxels of the whole pad, or the contact's features."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.fieldbus.protocol.tactile import Features, Shape, TactileHeader, TactileMode
from canprobe.fieldbus.protocol.tactile_assembler import TactileMessage


@dataclass(frozen=True, slots=True)
class TactileFrame:
    """One complete, checked tactile frame.

    Attributes:
        header: as received.
        taxels: uint8 (rows, columns), full pad, counts; zero outside the window, all zero in features mode; read-only.
        window: (first row, first column, rows, columns) that the taxels cover; (0, 0, 0, 0) in features mode.
        features: contact features, in features mode only.
        t_ns: arrival of the header.
        raw: (rows, columns, axes) values as they came, of a device of raw frames, whose header is made up; else None.
    """

    header: TactileHeader
    taxels: NDArray[np.uint8]
    window: tuple[int, int, int, int]
    features: Features | None
    t_ns: int
    raw: NDArray[np.int64] | None = None


def decode(message: TactileMessage, shape: Shape) -> TactileFrame:
    """The frame in a message of an array of so many rows and columns."""
    header, features = message.header, message.features
    taxels, window = np.zeros(shape, np.uint8), (0, 0, 0, 0)
    if features is None:
        rows, columns = (header.window, header.window) if header.mode is TactileMode.WINDOW else shape
        row, col = header.origin_row, header.origin_col
        counts = np.frombuffer(message.body, np.uint8, rows * columns).reshape(rows, columns)
        taxels[row : row + rows, col : col + columns] = counts
        window = (row, col, rows, columns)
    taxels.flags.writeable = False
    return TactileFrame(header, taxels, window, features, message.t_ns)
