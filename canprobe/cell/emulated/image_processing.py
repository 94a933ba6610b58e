"""The sensor's processing of a raw image: tare, gain, threshold, the window that follows the contact, features."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from canprobe.fieldbus.protocol.tactile import DEFAULT_WINDOW, MAX_SIDE, Features, Shape
from canprobe.mechanics.touch.pad import COUNTS_MAX
from canprobe.mechanics.types import Floats

Image = NDArray[np.uint8]
Raw = NDArray[np.uint8] | Floats
"""Counts of 255 at full scale: whole ones of an ADC of 8 bits, parts of counts of a finer one."""
UNIT_GAIN_PERMILLE = 1000
_HYSTERESIS = 0.75  # taxels the ideal origin must be away before the window moves; 0.5 would flicker


def is_overloaded(raw: Raw) -> bool:
    """Whether a taxel has reached full scale."""
    if raw.dtype == np.uint8:
        return COUNTS_MAX in raw.tobytes()
    return bool(raw.max() == COUNTS_MAX)


def correct(raw: Raw, tare: Floats | None, gain_permille: int, threshold: int) -> Image:
    """Raw counts → whole counts, tare subtracted, times the gain, saturated, zero below the threshold."""
    as_sampled = tare is None and gain_permille == UNIT_GAIN_PERMILLE and raw.dtype == np.uint8
    counts = raw if as_sampled else np.rint(_scaled(raw, tare, gain_permille))
    return _kept(threshold).take(counts.astype(np.intp), mode="clip")


@cache
def _kept(threshold: int) -> Image:
    """(256,) what remains of each count."""
    counts = np.arange(COUNTS_MAX + 1, dtype=np.uint8)
    counts[: max(threshold, 0)] = 0
    return counts


def correct_finely(raw: Raw, tare: Floats | None, gain_permille: int, threshold: int) -> Floats:
    """As ``correct``, with the parts of counts that a finer ADC sees and an image on the bus cannot carry."""
    counts = np.minimum(_scaled(raw, tare, gain_permille), COUNTS_MAX)
    counts[counts < max(threshold, 0)] = 0.0
    return counts


def _scaled(raw: Raw, tare: Floats | None, gain_permille: int) -> Floats:
    counts = raw.astype(np.float64)
    if tare is not None:
        counts -= tare
    if gain_permille != UNIT_GAIN_PERMILLE:
        counts *= gain_permille / UNIT_GAIN_PERMILLE
    return counts


@cache
def _sums(rows: int, columns: int) -> Floats:
    """(3, rows · columns): 1, row and column of each taxel."""
    row, column = np.indices((rows, columns), dtype=np.float64)
    return np.stack((np.ones(rows * columns), row.reshape(-1), column.reshape(-1)))


def _moments(image: Raw) -> tuple[float, float, float]:
    """Sum, centroid row, centroid column; the centre of the pad without a contact."""
    total, rows, columns = _sums(*image.shape).dot(image.reshape(-1)).tolist()
    if total == 0.0:
        return 0.0, (image.shape[0] - 1) / 2, (image.shape[1] - 1) / 2
    return total, rows / total, columns / total


def middle(window: int = DEFAULT_WINDOW, shape: Shape = (MAX_SIDE, MAX_SIDE)) -> tuple[int, int]:
    """First taxel (row, column) of a window in the middle of the pad."""
    return max(shape[0] - window, 0) // 2, max(shape[1] - window, 0) // 2


def follow(image: Raw, origin: tuple[int, int], window: int = DEFAULT_WINDOW) -> tuple[int, int]:
    """First taxel (row, column) of the window of so many taxels a side round the contact.

    The window stays while the contact's centroid is near its middle, and where it is without a contact.
    """
    total, row, column = _moments(image)
    if total == 0.0:
        return origin
    rows, columns = image.shape
    return _shift(origin[0], row, window, rows), _shift(origin[1], column, window, columns)


def _shift(origin: int, centroid: float, window: int, taxels: int) -> int:
    ideal = centroid - (window - 1) / 2
    if abs(ideal - origin) <= _HYSTERESIS:
        return origin
    return max(min(round(ideal), taxels - window), 0)


def compute_features(image: Raw, full_scale_pa: float, pitch_m: float) -> Features:
    """Force, centroid and central second moments of the whole pad.

    Args:
        image: corrected counts, (rows, columns), whole or not.
        full_scale_pa: pressure at 255 counts, Pa.
        pitch_m: pitch of the taxels.
    """
    total, row, column = _moments(image)
    if total == 0.0:
        return Features(0.0, row, column, 0.0, 0.0, 0.0, 0)
    weights = image / total
    rows, columns = image.shape
    d_row, d_column = np.arange(rows) - row, np.arange(columns) - column
    return Features(
        force_n=total / COUNTS_MAX * full_scale_pa * pitch_m**2,
        row=row,
        col=column,
        var_rr=float(d_row**2 @ weights.sum(axis=1)),
        var_rc=float(d_row @ weights @ d_column),
        var_cc=float(d_column**2 @ weights.sum(axis=0)),
        peak=round(float(image.max())),
    )
