"""A tactile frame as controllers see it: the taxels of the whole pad, or the contact's features; its place in time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.fieldbus.protocol.tactile import Features, Shape, TactileHeader, TactileMessage, TactileMode


@dataclass(frozen=True, slots=True)
class TactileFrame:
    """One complete, checked tactile frame.

    Attributes:
        header: header of the frame, as received.
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


@dataclass(frozen=True, slots=True)
class TactileSample:
    """A whole tactile frame with its place in time.

    Attributes:
        frame: the frame, complete and with the right CRC.
        t_sample_ns: instant at which the array was sampled, in the time of the cycle.
        cycle: the cycle whose SYNC triggered it, or the last one before it was sampled.
        t_sigma_s: standard deviation of that instant, s; 0 where a SYNC triggers the sample.
    """

    frame: TactileFrame
    t_sample_ns: int
    cycle: int
    t_sigma_s: float = 0.0

    @property
    def image(self) -> object:
        """The content of the frame, to be compared: what repeats where the array has stopped measuring."""
        return self.frame.features or self.frame.taxels.tobytes()

    def differs_from(self, other: TactileSample) -> bool:
        """Whether the array shows something else than in another sample."""
        return self.image != other.image


def covered(header: TactileHeader, shape: Shape) -> tuple[int, int, int, int]:
    """First row, first column, rows and columns of the taxels that a frame carries; none in features mode."""
    if header.mode is TactileMode.FEATURES:
        return 0, 0, 0, 0
    rows, columns = (header.window, header.window) if header.mode is TactileMode.WINDOW else shape
    return header.origin_row, header.origin_col, rows, columns


def frame_of(header: TactileHeader, content: NDArray[np.uint8] | Features, shape: Shape, t_ns: int) -> TactileFrame:
    """The frame with a content.

    Args:
        header: header of the frame.
        content: counts of the taxels that the frame carries (`covered`), or features.
        shape: rows and columns of the pad.
        t_ns: arrival.
    """
    taxels, window = np.zeros(shape, np.uint8), covered(header, shape)
    features = content if isinstance(content, Features) else None
    if not isinstance(content, Features):
        row, col, rows, columns = window
        taxels[row : row + rows, col : col + columns] = content
    taxels.flags.writeable = False
    return TactileFrame(header, taxels, window, features, t_ns)


def decode(message: TactileMessage, shape: Shape) -> TactileFrame:
    """The frame in a message of an array of so many rows and columns."""
    content: NDArray[np.uint8] | Features | None = message.features
    if content is None:
        _, _, rows, columns = covered(message.header, shape)
        content = np.frombuffer(message.body, np.uint8, rows * columns).reshape(rows, columns)
    return frame_of(message.header, content, shape, message.t_ns)
