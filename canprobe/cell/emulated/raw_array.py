"""An emulated array of raw frames, which knows no CANopen: free-running, polled, or sampling at SYNC.

It sends what its description says, frame by frame in the order of the description, and obeys its start and stop frames.
Of three axes only the normal one has a load; the others rest at the unloaded value. Taxels of an array that is tared
have unloaded values of their own.
"""

from __future__ import annotations

from collections.abc import Container, Sequence

import numpy as np

from canprobe.cell.emulated.array import TactilePlant
from canprobe.cell.scene.setup import Array
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.protocol.frames import SYNC_ID, Frame
from canprobe.mechanics.touch.pad import COUNTS_MAX

OFFSET_SHARE = 0.02
"""Half-width of the unloaded values' spread, as a share of the full scale."""


class RawArray(Participant):
    """The emulated device.

    Args:
        array: an array that sends raw frames.
        plant: shared with the nodes.
        sync_ratio: SYNCs between two images of a device that samples at SYNC.
        seed: seed of its unloaded values.

    Attributes:
        running: whether it was started; a device without a start frame always runs.
    """

    def __init__(self, array: Array, plant: TactilePlant, *, sync_ratio: int, seed: int) -> None:
        assert array.raw is not None
        self._wire = wire = array.raw
        self._plant = plant
        self._period_ns = round(1e9 / array.rate_hz)
        self._latency_ns = round(1e9 * wire.latency_s)
        self._ratio, self._syncs = sync_ratio, 0
        self.running = not wire.start
        self._due_ns: int | None = None
        self._span = wire.full_scale - wire.unloaded
        spread = OFFSET_SHARE * abs(self._span) if wire.tare_images else 0.0
        offsets = np.random.default_rng(seed).uniform(-spread, spread, array.pad.shape) if spread else 0.0
        self._unloaded = np.rint(wire.unloaded + np.zeros(array.pad.shape) + offsets)
        self._waiting: list[tuple[int, list[Frame]]] = []

    @property
    def listens(self) -> Container[int]:
        """Identifiers of its commands, and of SYNC where a SYNC triggers its images."""
        commands = {can_id for can_id, _ in (*self._wire.start, *self._wire.stop, *self._wire.poll)}
        return frozenset(commands | {SYNC_ID} if self._wire.sampling == "sync" else commands)

    @property
    def next_deadline_ns(self) -> int | None:
        dues = [due for due, _ in self._waiting]
        return min([*dues, self._due_ns]) if self._due_ns is not None else min(dues, default=None)

    def start(self, t_ns: int) -> Sequence[Frame]:
        if self.running and self._wire.sampling == "free":
            self._due_ns = t_ns + self._period_ns
        return ()

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        wire, frame = self._wire, (can_id, data)
        if wire.start and frame == wire.start[-1]:
            self.running = True
            if wire.sampling == "free" and self._due_ns is None:
                self._due_ns = t_ns + self._period_ns
        elif frame in wire.stop:
            self.running, self._due_ns = False, None
        elif wire.poll and frame == wire.poll[-1] and self.running:
            self._sample(t_ns)
        elif can_id == SYNC_ID and wire.sampling == "sync" and self.running:
            self._syncs += 1
            if self._syncs % self._ratio == 0:
                self._sample(t_ns)
        return self._ready(t_ns)

    def advance(self, t_ns: int) -> Sequence[Frame]:
        if self._due_ns is not None and self._due_ns <= t_ns:
            self._sample(self._due_ns)
            self._due_ns += self._period_ns * (1 + (t_ns - self._due_ns) // self._period_ns)
        return self._ready(t_ns)

    def _sample(self, t_ns: int) -> None:
        self._plant.begin(t_ns)
        self._plant.advance(t_ns)
        loads = self._plant.sample_image(t_ns).astype(np.float64) / COUNTS_MAX
        image = self._wire.image
        counts = np.empty((image.rows, image.columns, image.axes), dtype=np.int64)
        counts[:] = self._unloaded[:, :, None]
        counts[:, :, self._wire.normal] = np.rint(self._unloaded + self._span * loads)
        self._waiting.append(
            (t_ns + self._latency_ns, image.encode(np.clip(counts, *image.range).reshape(-1).tolist()))
        )

    def _ready(self, t_ns: int) -> list[Frame]:
        """The frames of the images that have waited for the latency."""
        ready = [frame for due, frames in self._waiting if due <= t_ns for frame in frames]
        self._waiting = [one for one in self._waiting if one[0] > t_ns]
        return ready
