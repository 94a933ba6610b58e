"""The run's log: one row a cycle in memory, columns with units as arrays; all of them, or the last ones."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import MutableSequence
from itertools import chain

import numpy as np
from numpy.typing import NDArray


class RunLog:
    """Collects named columns row by row; a column that a row lacks is filled with NaN there.

    Column names carry their unit as a suffix (``t_s``, ``q_deg``, ``force_n``). Values are numbers or small vectors.
    A row is kept as it comes: in the cycle that costs a tenth of sorting its values into columns.

    Args:
        kept: how many rows are kept, the last ones: a cell that is left running for days must not grow; None for all.
    """

    def __init__(self, kept: int | None = None) -> None:
        self._rows: MutableSequence[tuple[tuple[str, ...], tuple[object, ...]]]
        self._rows = [] if kept is None else deque(maxlen=kept)
        self._names: dict[tuple[str, ...], tuple[str, ...]] = {}  # each set of names once

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: dict[str, object]) -> None:
        """Append one row."""
        names = tuple(row)
        self._rows.append((self._names.setdefault(names, names), tuple(row.values())))

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Every column that the rows have, (n,) or (n, k).

        A value of another shape than its column's first, or none, is NaN, with a warning: one must not cost the others.
        One column after the other: all of them at once take as much memory again as the rows.
        """
        kinds = {id(names): names for names, _ in self._rows}
        return {
            name: self._array(name, {kind: names.index(name) for kind, names in kinds.items() if name in names})
            for name in dict.fromkeys(chain.from_iterable(kinds.values()))
        }

    def _array(self, name: str, places: dict[int, int]) -> NDArray[np.float64]:
        """A column, which rows of some kinds (the identity of their names) have at these places."""
        known = [
            (i, value)
            for i, (names, values) in enumerate(self._rows)
            if (place := places.get(id(names))) is not None and (value := values[place]) is not None
        ]
        shape = np.asarray(known[0][1]).shape if known else ()
        out = np.full((len(self._rows), *shape), np.nan)
        misfits = 0
        for i, value in known:
            try:
                out[i] = value
            except (TypeError, ValueError):
                misfits += 1
        if misfits:
            told = (
                f"log: {misfits} values of column {name!r} are no numbers of shape {shape}, as its first is: left NaN"
            )
            warnings.warn(told, stacklevel=3)
        return out
