"""Taxels that do not measure: dead ones in one image, silent ones by several; both are bridged.

A **dead** taxel inside a patch at 2 N moves the centroid by up to a tenth of a pitch and lowers the force by some
percent. It reads nothing while its four neighbours are pressed, and is bridged by them (`mended`). At the rim it cannot
be distinguished from the end of the patch, and hardly matters.

A whole row or column that fails has no pressed taxel on two of its four sides, so that one image does not show it.
Several do: the row reads nothing, or always the same, while the rows on both sides were pressed at once
(`SilentTaxels`). The cover spreads pressure over about a pitch, so that no object leaves such a gap. A taxel that
changes is taken for whole again at once; a finding costs nothing where it does not hold.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.pad import COUNTS_MAX
from canprobe.mechanics.types import Floats

MIN_COUNTS = 20
"""Least count of each of the four neighbours: more than the pressure of a patch can fall from one taxel to the next."""
_LEVELS = bytes((count > 0) + (count >= MIN_COUNTS) for count in range(256))
_GAP = bytes((2, 0, 2))
"""A dead taxel between its left and its right neighbour, in levels of counts."""
Image = NDArray[np.uint8]
LOOK_PERIOD_NS = 50_000_000
"""Time between two images that are looked at."""
NEEDED_LOOKS = 5
"""Looks at which a taxel was silent beside pressed ones before it is found: a quarter of a second of contact."""
MAX_CHANGE_COUNTS = 2
"""Largest change of a silent taxel: a whole one that is pressed has more noise."""
WIDE_GAP_COUNTS = 60
"""Least count on both sides of a gap of two taxels: the blur of an edge of so much shows in the next taxel."""
STEEP_COUNTS, STEEP_SHARE = 45, 0.4
"""Least count beside a silent taxel, whatever is on its other side, and least share of the highest count; only on
arrays with `MIN_BLUR_PITCH`."""
MIN_BLUR_PITCH = 0.6
"""Blur, in pitches, from which on an edge of up to 1.5 times the full scale shows in the taxel beside a steep one."""
LINE_TAXELS = 2
"""Number of silent taxels of one row or column that make the rest of it suspect, as far as it is silent, too."""
_Mask = NDArray[np.bool_]


def mended(taxels: Image) -> tuple[Image, int]:
    """The image with its dead taxels bridged, and their number.

    The same array (rows, columns) is returned where none is dead; else a copy in which each dead taxel has the mean of
    its four neighbours.
    """
    if _GAP not in taxels.tobytes().translate(_LEVELS):  # a quick test before the whole search, mostly true
        return taxels, 0
    inner = taxels[1:-1, 1:-1]
    sides = (taxels[:-2, 1:-1], taxels[2:, 1:-1], taxels[1:-1, :-2], taxels[1:-1, 2:])
    least = np.minimum(np.minimum(sides[0], sides[1]), np.minimum(sides[2], sides[3]))
    # 255 makes the limit too high for any count where the taxel itself reads something; uint8 would wrap
    dead = least > (MIN_COUNTS - 1) + 255 * (inner > 0).astype(np.int16)
    n = int(np.count_nonzero(dead))
    if n == 0:
        return taxels, 0
    mean = np.mean(np.stack([s.astype(np.float64) for s in sides]), axis=0)
    whole = taxels.copy()
    whole[1:-1, 1:-1][dead] = np.rint(mean[dead]).astype(np.uint8)
    return whole, n


class SilentTaxels:
    """Looks at the images of one array, remembers which taxels do not measure, and bridges them.

    Args:
        shape: rows and columns of the array.
        stated: (row, column) of taxels that are known to be dead; they are bridged from the start, and not named.
        blur_pitch: standard deviation of the blur by the cover, in pitches; 0 where it is not known.
    """

    def __init__(
        self, shape: tuple[int, int], stated: Iterable[tuple[int, int]] = (), *, blur_pitch: float = 0.0
    ) -> None:
        self._low, self._high = np.full(shape, COUNTS_MAX, np.uint8), np.zeros(shape, np.uint8)
        self._down, self._across = np.zeros((2, *shape), np.uint8)  # looks with pressed taxels above and below; beside
        self._stated = np.zeros(shape, bool)
        for row, column in stated:
            if row < shape[0] and column < shape[1]:  # the calibration may be that of a larger array
                self._stated[row, column] = True
        self._mask, self._found = self._stated, np.zeros(shape, bool)
        self._any = bool(self._mask.any())
        self._blurred = blur_pitch >= MIN_BLUR_PITCH
        self._next_ns: int | None = None
        self._bridge = lru_cache(partial(_bridge, self._mask))

    def look(self, taxels: Image, window: Sequence[int], t_ns: int) -> None:
        """Look at an image; nothing happens where the last look was less than `LOOK_PERIOD_NS` before.

        Args:
            taxels: (rows, columns) counts of the whole array.
            window: first row, first column, rows, columns that were sent.
            t_ns: time of the image.
        """
        if self._next_ns is not None and t_ns < self._next_ns:
            return
        self._next_ns = t_ns + LOOK_PERIOD_NS
        row, column, rows, columns = window
        part = slice(row, row + rows), slice(column, column + columns)
        now, low, high = taxels[part], self._low[part], self._high[part]
        np.minimum(low, now, out=low)
        np.maximum(high, now, out=high)
        silent = high - low <= MAX_CHANGE_COUNTS  # unseen ones have 0 − 255 = 1
        if self._any and (self._found[part] & ~silent).any():
            self._down[part][~silent] = self._across[part][~silent] = 0
            self._find()
        peak = int(now.max(initial=0))
        if peak < MIN_COUNTS:
            return
        loud = np.where(silent, 0, now)
        steep = max(STEEP_COUNTS, STEEP_SHARE * peak) if self._blurred else math.inf
        gaps = _gaps(loud, steep)
        if self._any:  # what is found already counts as pressed, so that a row beside it shows
            filled = self.bridged(taxels, window)[0][part]
            more = _gaps(np.where(self._mask[part], filled, loud), steep)
            gaps = gaps[0] | more[0], gaps[1] | more[1]
        gaps = gaps[0] & silent, gaps[1] & silent
        if not (gaps[0].any() or gaps[1].any()):
            return
        # where a silent taxel reads something, its neighbours must have changed by as much
        rise = np.pad(now - low >= MIN_COUNTS, 1)
        stuck = (low > MAX_CHANGE_COUNTS) & ~(rise[:-2, 1:-1] | rise[2:, 1:-1] | rise[1:-1, :-2] | rise[1:-1, 2:])
        enough = False
        for looks, gap in zip((self._down[part], self._across[part]), gaps, strict=True):
            looks[gap & (looks < NEEDED_LOOKS) & ~stuck] += 1
            enough = enough or bool((looks >= NEEDED_LOOKS).any())
        if enough:
            self._find()

    def _find(self) -> None:
        """Put together what is bridged from now on."""
        silent = self._high - self._low <= MAX_CHANGE_COUNTS
        # one taxel alone needs pressed ones on all sides, as the rim of a patch may look like it on two
        mask = self._stated | (silent & (np.minimum(self._down, self._across) >= NEEDED_LOOKS))
        for looks, quiet, into in ((self._down, silent, mask), (self._across.T, silent.T, mask.T)):
            sure = (looks >= NEEDED_LOOKS) & quiet
            lines = sure.sum(axis=1) >= LINE_TAXELS
            lines[1:-1] |= lines[:-2] & lines[2:]  # nothing is pressed beside a row between two silent ones
            np.logical_or(into, quiet & lines[:, None], out=into)
        if not np.array_equal(mask, self._mask):
            self._mask, self._found = mask, mask & ~self._stated
            self._any = bool(mask.any())
            self._bridge = lru_cache(partial(_bridge, mask))

    @property
    def found(self) -> int:
        """Number of taxels that were found, without those that were stated."""
        return int(np.count_nonzero(self._found)) if self._any else 0

    @property
    def words(self) -> str:
        """Rows, columns and taxels that were found, in words; empty where none was."""
        sure = ((self._down >= NEEDED_LOOKS) | (self._across >= NEEDED_LOOKS)) & self._found
        sure[1:-1] |= self._found[1:-1] & sure[:-2] & sure[2:]
        sure[:, 1:-1] |= self._found[:, 1:-1] & sure[:, :-2] & sure[:, 2:]
        silent = self._high - self._low <= MAX_CHANGE_COUNTS
        nothing = self._high <= MAX_CHANGE_COUNTS
        said, left = [], sure.copy()
        while left.any():
            lines = [(int(n), "row", i) for i, n in enumerate(left.sum(axis=1))]
            lines += [(int(n), "column", i) for i, n in enumerate(left.sum(axis=0))]
            number, kind, i = max(lines, key=lambda line: line[0])
            if number < LINE_TAXELS:
                break
            line = np.s_[i] if kind == "row" else np.s_[:, i]
            places = np.flatnonzero(left[line])
            what = f"{kind} {i} of the array reads {'nothing' if nothing[line][places].all() else 'always the same'}"
            if not silent[line].all():
                what += f" in {'columns' if kind == 'row' else 'rows'} {places[0]} to {places[-1]}"
            said.append(what)
            left[line] = False
        for row, column in np.argwhere(left).tolist():
            what = "nothing" if nothing[row, column] else "always the same"
            said.append(f"the taxel in row {row}, column {column} of the array reads {what}")
        return "; ".join(said)

    def bridged(self, taxels: Image, window: Sequence[int]) -> tuple[Image, int, float]:
        """The image with silent taxels interpolated, the number of those under pressure, and their share of its sum.

        The values make the sum of squared second differences least, along rows and along columns.

        Args:
            taxels: (rows, columns) counts of the whole array.
            window: first row, first column, rows, columns that were sent.
        """
        if not self._any:
            return taxels, 0, 0.0
        row, column, rows, columns = window
        part = slice(row, row + rows), slice(column, column + columns)
        places, weights = self._bridge(tuple(window))
        if not len(places):
            return taxels, 0, 0.0
        seen = taxels[part].reshape(-1)
        values = np.clip(np.rint(weights.dot(seen)), 0, COUNTS_MAX)
        whole = taxels.copy()
        inside = seen.copy()
        inside[places] = values
        whole[part] = inside.reshape(rows, columns)
        filled = float(values.sum())
        return whole, int(np.count_nonzero(values)), filled / max(float(inside.sum(dtype=np.int64)), 1.0)


def _gaps(image: Image, steep: float) -> tuple[_Mask, _Mask]:
    """Where taxels above and below, and on both sides, are pressed as they cannot be beside a whole one that is not."""
    # one side alone is enough from a count of `steep` on, where the next taxel of the row or column shows the same: one
    # taxel may be the rim of a patch on an array with less blur than its calibration has
    gaps = []
    for seen in (image, image.T):
        wide = np.zeros((len(seen) + 4, seen.shape[1]), np.uint8)  # np.pad takes longer than all the rest
        wide[2:-2] = seen
        far_up, up, down, far_down = wide[:-4], wide[1:-3], wide[3:-1], wide[4:]
        gap, most = np.minimum(up, down) >= MIN_COUNTS, np.maximum(up, down)
        if most.max() >= WIDE_GAP_COUNTS:
            gap |= np.maximum(np.minimum(up, far_down), np.minimum(far_up, down)) >= WIDE_GAP_COUNTS
        if steep <= COUNTS_MAX:
            alone = (most >= steep) & (seen == 0)
            pairs = alone[:, 1:] & alone[:, :-1]
            gap[:, 1:] |= pairs
            gap[:, :-1] |= pairs
        gaps.append(gap)
    return gaps[0], gaps[1].T


def _bridge(mask: _Mask, window: tuple[int, ...]) -> tuple[NDArray[np.intp], Floats]:
    """Places (n,) of the taxels of a mask in a window, and (n, taxels) weights of its taxels that interpolate them."""
    row, column, rows, columns = window
    mask = np.ascontiguousarray(mask[row : row + rows, column : column + columns])
    places = np.flatnonzero(mask)
    index = np.arange(mask.size).reshape(rows, columns)
    triples = np.concatenate(
        [
            np.stack([index[:-2], index[1:-1], index[2:]], axis=-1).reshape(-1, 3),
            np.stack([index[:, :-2], index[:, 1:-1], index[:, 2:]], axis=-1).reshape(-1, 3),
        ]
    )
    triples = triples[mask.reshape(-1)[triples].any(axis=1)]
    second = np.zeros((len(triples), mask.size))
    second[np.arange(len(triples))[:, None], triples] = 1.0, -2.0, 1.0
    unknown = second[:, places]
    second[:, places] = 0.0
    # why not solve: in a window without a whole taxel the equations are singular
    weights: Floats = np.asarray(np.linalg.lstsq(unknown, -second, rcond=None)[0], np.float64)
    return places, weights
