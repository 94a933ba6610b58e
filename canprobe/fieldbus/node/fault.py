"""A fault of a node or its link: what happens, when, and how often. `faulty_node` makes it happen."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from random import Random


class FaultKind(Enum):
    """Kinds of faults between a node and the bus, or in the node."""

    DROP = "drop"
    DELAY = "delay"
    DUPLICATE = "duplicate"
    CORRUPT = "corrupt"
    REORDER = "reorder"
    MUTE = "mute"
    DEAF = "deaf"
    REBOOT = "reboot"
    FREEZE = "freeze"
    BABBLE = "babble"
    WRONG_DATA = "wrong data"


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Attributes:
        kind: kind of the fault.
        node_id: id of the node.
        start_ns, duration_ns: beginning, on the clock of the bus, and duration.
        share: share of the frames that it hits, 0…1.
        incoming: whether it hits the frames that the node receives; else it hits those that the node sends.
        amount_ns: delay of a frame, or time between two frames of a babbling node.
        seed: seed of its random choices.
    """

    kind: FaultKind
    node_id: int
    start_ns: int
    duration_ns: int
    share: float = 1.0
    incoming: bool = False
    amount_ns: int = 1_000_000
    seed: int = 0

    @property
    def end_ns(self) -> int:
        """End of the fault, on the clock of the bus."""
        return self.start_ns + self.duration_ns

    def holds(self, t_ns: int) -> bool:
        """Whether the fault is present."""
        return self.start_ns <= t_ns < self.end_ns

    def __str__(self) -> str:
        way = " incoming" if self.incoming else ""
        return (
            f"{self.kind.value}{way} at node {self.node_id}, {self.start_ns * 1e-9:.4f} s for"
            f" {self.duration_ns * 1e-6:.1f} ms, {100 * self.share:.0f} %"
        )


def flip_bit(data: bytes, rng: Random) -> bytes:
    """The data with one bit changed, or cut short, as the CRC of the wire lets it pass once in a lifetime."""
    if not data:
        return data
    if rng.random() < 0.2:
        return data[: rng.randrange(len(data))]
    place, bit = rng.randrange(len(data)), 1 << rng.randrange(8)
    return data[:place] + bytes((data[place] ^ bit,)) + data[place + 1 :]
