"""How far behind their SYNC the frames of a bus come: those of a whole stretch of traffic at once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from canprobe.protocol.frames import SYNC_ID

Ints = NDArray[np.int64]
NEVER = np.iinfo(np.int64).max
"""Time of a SYNC that nobody saw."""
HEADER_BYTES = 8


@dataclass(frozen=True, slots=True)
class Delay:
    """Frames of one identifier.

    Attributes:
        cob_id: the identifier.
        late: how many were later than the plan's worst case.
        slowest_ns: the longest from the end of the SYNC's frame to the end of theirs.
    """

    cob_id: int
    late: int
    slowest_ns: int


@dataclass(slots=True)
class Lateness:
    """Measures stretch after stretch, each from one SYNC to before another.

    Attributes:
        latest_ns: worst case of each identifier that is to be measured.
        tactile_ids: those of them whose SYNC is the one that the header names.
        header_id: the first of the tactile PDOs; None without.
    """

    latest_ns: Mapping[int, int]
    tactile_ids: frozenset[int]
    header_id: int | None
    _by_counter: dict[int, int] = field(init=False, default_factory=dict)
    _tactile_ns: int = field(init=False, default=NEVER)

    def take(self, ids: Sequence[int], data: Sequence[bytes], times_ns: Sequence[int]) -> Iterator[Delay]:
        """The delays in a stretch that begins with a SYNC."""
        numbers, times = np.array(ids, np.int64), np.array(times_ns, np.int64)
        syncs = np.flatnonzero(numbers == SYNC_ID)
        triggers = times[syncs][np.cumsum(numbers == SYNC_ID) - 1]
        of_tactile = self._tactile_triggers(numbers, data, times)
        for cob_id, latest in self.latest_ns.items():
            at = np.flatnonzero(numbers == cob_id)
            trigger = (of_tactile if cob_id in self.tactile_ids else triggers)[at]
            known = trigger != NEVER
            took = (times[at] - trigger)[known]
            if took.size:
                yield Delay(cob_id, int(np.count_nonzero(took > latest)), int(took.max()))

    def _tactile_triggers(self, numbers: Ints, data: Sequence[bytes], times: Ints) -> Ints:
        """For each frame, when the SYNC was through that the last tactile header named."""
        places, named = [0], [self._tactile_ns]
        measured = self.header_id in self.latest_ns
        for at in np.flatnonzero((numbers == SYNC_ID) | (numbers == (self.header_id or SYNC_ID))).tolist():
            head = data[at]
            if numbers[at] == SYNC_ID:
                self._by_counter[head[0] if head else 0] = int(times[at])
            elif measured:
                places.append(at)
                named.append(self._by_counter.get(head[1], NEVER) if len(head) == HEADER_BYTES else NEVER)
        self._tactile_ns = named[-1]
        return np.array(named, np.int64)[np.searchsorted(places, np.arange(len(numbers)), "right") - 1]
