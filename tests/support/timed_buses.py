"""Participants that say what they are told, on a bus with a bit rate."""

from __future__ import annotations

from collections.abc import Sequence

from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.bus.virtual.timed import TimedBus
from canprobe.fieldbus.protocol.frames import Frame

BIT = 1000  # ns, at 1 Mbit/s
INTERMISSION = 3 * BIT


class Scripted(Participant):
    """Says fixed frames at fixed times and fixed answers to fixed identifiers; remembers what it heard."""

    def __init__(
        self, timed: dict[int, Sequence[Frame]] | None = None, answers: dict[int, Sequence[Frame]] | None = None
    ):
        self.timed = dict(timed or {})
        self.answers = answers or {}
        self.heard: list[tuple[int, bytes, int]] = []

    @property
    def next_deadline_ns(self) -> int | None:
        return min(self.timed, default=None)

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        self.heard.append((can_id, data, t_ns))
        return self.answers.get(can_id, ())

    def advance(self, t_ns: int) -> Sequence[Frame]:
        return self.timed.pop(min(self.timed))


def make_bus(*participants, kind=TimedBus, **options):
    bus = kind(VirtualClock(), "can7", **options)
    seen = []
    bus.recorder = lambda *frame: seen.append(frame)
    for participant in participants:
        bus.attach(participant)
    return bus, seen


class Source(Participant):
    """Sends one message: queues a frame of its own at given times."""

    def __init__(self, frame: Frame, times: Sequence[int]):
        self.frame = frame
        self.times = sorted(times)

    @property
    def next_deadline_ns(self) -> int | None:
        return self.times[0] if self.times else None

    def advance(self, t_ns: int) -> Sequence[Frame]:
        self.times.pop(0)
        return [self.frame]
