"""The run's log: a row a cycle and a row a tactile frame, in memory; and the notes of what went wrong."""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Iterable, Mapping, MutableSequence, Sequence
from copy import copy
from dataclasses import astuple, dataclass, field, fields
from itertools import count, groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.controller import TactileSample
from canprobe.errors import CanprobeError, NodeError
from canprobe.fieldbus.protocol.tactile import Features

_NO_NUMBERS = (TypeError, ValueError, OverflowError)
_Part = tuple[list[int], Sequence[Any] | NDArray[np.float64]]
"""Rows of a column and their values."""


class _RowKind:
    """Rows with the same names: how their values lie in one block of float64, as the first whole row has them.

    Args:
        names: of the columns, in order.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self.names = names
        self._block = np.empty(0)
        self._views: list[NDArray[np.float64]] = []

    def packed(self, values: Iterable[Any]) -> bytes | tuple[Any, ...]:
        """A copy of a row's values: one block, or a tuple where one of them is no number or has another shape."""
        try:
            if not self._views:
                self._lay_out([np.asarray(value) for value in values])
            for view, value in zip(self._views, values, strict=True):
                view[...] = value
        except _NO_NUMBERS:
            return tuple(copy(value) for value in values)
        return self._block.tobytes()

    @property
    def width(self) -> int:
        """Numbers in a block."""
        return len(self._block)

    def column(self, name: str, blocks: NDArray[np.float64]) -> NDArray[np.float64]:
        """The values (n, ...) of a name in blocks (n, width)."""
        place = self.names.index(name)
        start, shape = sum(view.size for view in self._views[:place]), self._views[place].shape
        return blocks[:, start : start + self._views[place].size].reshape(len(blocks), *shape)

    def _lay_out(self, values: Sequence[NDArray[Any]]) -> None:
        if any(value.dtype.kind not in "biuf" for value in values):
            return
        self._block = np.empty(sum(value.size for value in values))
        start = 0
        for value in values:
            self._views.append(self._block[start : start + value.size].reshape(value.shape))
            start += value.size


class RunLog:
    """Collects named columns row by row; a column that a row lacks is filled with NaN there.

    Column names carry their unit as a suffix (``t_s``, ``q_rad``, ``force_n``). Values are numbers or small vectors.
    A row is kept as one block of numbers: sorting its values into columns would cost ten times as much in the cycle,
    keeping them as they come four times the memory. Nothing in it changes with the arrays that were given.

    Args:
        kept: how many rows are kept, the last ones: a cell that is left running for days must not grow; None for all.
    """

    def __init__(self, kept: int | None = None) -> None:
        self._rows: MutableSequence[tuple[_RowKind, bytes | tuple[Any, ...]]]
        self._rows = [] if kept is None else deque(maxlen=kept)
        self._kinds: dict[tuple[str, ...], _RowKind] = {}

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, row: dict[str, object]) -> None:
        """Append one row."""
        names = tuple(row)
        kind = self._kinds.get(names)
        if kind is None:
            kind = self._kinds[names] = _RowKind(names)
        self._rows.append((kind, kind.packed(row.values())))

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """Every column that the rows have, (n,) or (n, k).

        A value of another shape than its column's first, or none, is NaN, with a warning: one must not cost the others.
        """
        kinds = dict.fromkeys(kind for kind, _ in self._rows)
        columns: dict[str, list[_Part]] = {name: [] for kind in kinds for name in kind.names}
        blocks: dict[_RowKind, tuple[list[int], list[bytes]]] = {}
        for i, (kind, values) in enumerate(self._rows):
            if isinstance(values, bytes):
                rows, packed = blocks.setdefault(kind, ([], []))
                rows.append(i)
                packed.append(values)
            else:
                for name, value in zip(kind.names, values, strict=True):
                    if value is not None:
                        columns[name].append(([i], [value]))
        for kind, (rows, packed) in blocks.items():
            table = np.frombuffer(b"".join(packed)).reshape(len(rows), kind.width)
            for name in kind.names:
                columns[name].append((rows, kind.column(name, table)))
        return {name: self._column(name, parts) for name, parts in columns.items()}

    def _column(self, name: str, parts: list[_Part]) -> NDArray[np.float64]:
        """A column of its parts; the first value of all decides the shape."""
        parts = sorted(parts, key=lambda part: part[0][0])
        try:
            shape = np.shape(parts[0][1][0]) if parts else ()
        except ValueError:  # rows of unequal length
            shape = ()
        out = np.full((len(self._rows), *shape), np.nan)
        misfits = 0
        for rows, values in parts:
            if isinstance(values, np.ndarray) and values.shape[1:] == shape:
                out[rows] = values
                continue
            for i, value in zip(rows, values, strict=True):
                try:
                    out[i] = value
                except _NO_NUMBERS:
                    misfits += 1
        if misfits:
            text = (
                f"log: {misfits} values of column {name!r} are no numbers of shape {shape}, as its first is: left NaN"
            )
            warnings.warn(text, stacklevel=3)
        return out


# Positions of joints: columns `q_rad` for those that turn, `q_m` for those that slide, one place a joint in each.


def joint_columns(
    name: str, q: NDArray[np.float64], prismatic: NDArray[np.bool_] | None
) -> dict[str, NDArray[np.float64]]:
    """Joint positions as columns of the log: of an arm whose joints all turn `name_rad` alone, else with `name_m`.

    Args:
        name: `q` or `q_target`.
        q: (n,) rad or m.
        prismatic: (n,) which joints slide; None: none of them.

    Returns:
        (n,) each, NaN where a joint is of the other kind.
    """
    if prismatic is None:
        return {f"{name}_rad": q}
    sliding = {f"{name}_m": np.where(prismatic, q, np.nan)}
    return sliding if prismatic.all() else {f"{name}_rad": np.where(prismatic, np.nan, q), **sliding}


def joint_positions(log: Mapping[str, NDArray[np.float64]], name: str = "q") -> NDArray[np.float64] | None:
    """The inverse of `joint_columns` for a whole log: (rows, n) rad or m; None where it has no such columns.

    Args:
        log: columns by name.
        name: `q` or `q_target`.
    """
    turning, sliding = log.get(f"{name}_rad"), log.get(f"{name}_m")
    if turning is None or sliding is None:
        return sliding if turning is None else turning
    return np.where(np.isnan(turning), sliding, turning)


class TactileLog:
    """The tactile frames that the cell used: images and what belongs to them, for `tactile.npz`.

    Args:
        kept: how many frames are kept, the last ones; None for all.
    """

    def __init__(self, kept: int | None = None) -> None:
        self._rows: MutableSequence[tuple[int, TactileSample]] = [] if kept is None else deque(maxlen=kept)

    def add(self, t_ns: int, sample: TactileSample) -> None:
        """Append the sample that became usable in the cycle at ``t_ns``."""
        self._rows.append((t_ns, sample))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """One row a frame (m, ...): when it was usable and sampled, s, taxels, their window, features; empty without.

        Features (m, 7) are NaN in a frame of taxels. A device of raw frames has their values (m, rows, columns, axes).
        """
        if not self._rows:
            return {}
        frames = [sample.frame for _, sample in self._rows]
        none = (np.nan,) * len(fields(Features))
        raw = [frame.raw for frame in frames if frame.raw is not None]
        return ({"raw": np.array(raw)} if raw else {}) | {
            "t_s": np.array([t_ns * 1e-9 for t_ns, _ in self._rows]),
            "t_sample_s": np.array([sample.t_sample_ns * 1e-9 for _, sample in self._rows]),
            "t_sigma_s": np.array([sample.t_sigma_s for _, sample in self._rows]),
            "taxels": np.array([frame.taxels for frame in frames]),
            "window": np.array([frame.window for frame in frames]),
            "features": np.array([none if f.features is None else astuple(f.features) for f in frames]),
        }


# What went wrong in a run and was lived with: one line a kind, however often it happened.

KINDS_KEPT = 100
"""Kinds that are distinguished; a node that sends another EMCY each time must not fill the memory."""
OTHERS = "more of other kinds"


@dataclass(slots=True)
class _NoteKind:
    """One thing that happens again and again."""

    what: str
    nodes: set[int] = field(default_factory=set)
    times: int = 0
    first_s: float | None = None
    last_s: float | None = None

    def __str__(self) -> str:
        who = f"{nodes_text(self.nodes)}: " if self.nodes else ""
        how_often = f", {self.times} times" if self.times > 1 else ""
        when = ""
        if self.first_s is not None and self.last_s is not None:
            first, last = f"at {self.first_s:.2f} s", f", last at {self.last_s:.2f} s"
            when = f", {first}" if self.times == 1 else f", first {first}{last}"
        return f"{who}{self.what}{how_often}{when}"


class Notes:
    """Counts faults by kind, in the order of the first of each. ``bus.log`` has them frame by frame."""

    def __init__(self) -> None:
        self._kinds: dict[str, _NoteKind] = {}

    def __len__(self) -> int:
        """How many kinds there are."""
        return len(self._kinds)

    def add(self, what: str, *, node_id: int | None = None, t_s: float | None = None) -> None:
        """It happened, once more.

        Args:
            what: names the kind; nothing in it may change from one time to the next.
            node_id: the node that it happened to.
            t_s: on the run's clock.
        """
        if what not in self._kinds and len(self._kinds) >= KINDS_KEPT:
            what = OTHERS
        kind = self._kinds.setdefault(what, _NoteKind(what))
        kind.times += 1
        if node_id is not None:
            kind.nodes.add(node_id)
        if t_s is not None:
            kind.first_s = t_s if kind.first_s is None else kind.first_s
            kind.last_s = t_s

    def add_error(self, error: CanprobeError, then: str, t_s: float) -> None:
        """The cell found an error, and ``then`` did something about it."""
        reason, node_id = (error.reason, error.node_id) if isinstance(error, NodeError) else (str(error), None)
        self.add(f"{reason}: {then}", node_id=node_id, t_s=t_s)

    def lines(self) -> list[str]:
        """A line for each kind."""
        return [str(kind) for kind in self._kinds.values()]


def nodes_text(node_ids: Iterable[int]) -> str:
    """Nodes in words, neighbours joined: ``nodes 1-6, 16``."""
    ids = sorted(node_ids)
    steps = count()
    runs = [list(run) for _, run in groupby(ids, key=lambda node_id: node_id - next(steps))]
    parts = [part for run in runs for part in ([f"{run[0]}-{run[-1]}"] if len(run) > 2 else map(str, run))]
    return f"node{'s' * (len(ids) > 1)} {', '.join(parts)}"
