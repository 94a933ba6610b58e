"""Records what is true in the plant at every SYNC, beside what the nodes measure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from canprobe.protocol.frames import SYNC_ID, Frame


class TruePlant(Protocol):
    """A plant that tells its present true values."""

    def advance(self, t_ns: int) -> None:
        """Bring the plant to `t_ns`; idempotent."""

    def state(self) -> Any:
        """The present state, all that the truth follows from."""

    def truth(self, state: Any) -> Mapping[str, Any]:
        """True values of a state: numbers and arrays, always under the same names."""


class TruthRecorder:
    """A silent participant of the bus that writes down the plant's state at every SYNC.

    What is true in that state is computed afterwards: in real time it would make the nodes' next answers late.

    Args:
        plant: whose truth.

    Attributes:
        origin_ns: time on the bus's clock that is 0 in the column ``t_s``.
    """

    name = "truth recorder"
    witness = True
    listens = frozenset((SYNC_ID,))

    def __init__(self, plant: TruePlant) -> None:
        self._plant = plant
        self.origin_ns = 0
        self._rows: list[tuple[int, int, Any]] = []

    @property
    def next_deadline_ns(self) -> None:
        """Only a SYNC wakes it."""
        return None

    def start(self, t_ns: int) -> list[Frame]:
        """Nothing to say."""
        return []

    def advance(self, t_ns: int) -> list[Frame]:
        """Nothing is ever due."""
        return []

    def receive(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        """On a SYNC, take the state."""
        if can_id == SYNC_ID:
            self._plant.advance(t_ns)
            self._rows.append((t_ns, data[0] if data else 0, self._plant.state()))
        return []

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Columns, one row a SYNC: t_s (s), sync_count (0, 1, …), sync_counter (of the frame, 0 without), the truth."""
        columns: dict[str, NDArray[Any]] = {
            "t_s": np.array([t_ns - self.origin_ns for t_ns, _, _ in self._rows], dtype=np.float64) * 1e-9,
            "sync_count": np.arange(len(self._rows), dtype=np.int64),
            "sync_counter": np.array([counter for _, counter, _ in self._rows], dtype=np.int64),
        }
        truths = [self._plant.truth(state) for _, _, state in self._rows]
        for name in truths[0] if truths else ():
            columns[name] = np.array([truth[name] for truth in truths])
        return columns
