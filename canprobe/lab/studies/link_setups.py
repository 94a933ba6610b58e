"""Links that are constructed: a bus in virtual time whose port delays, scatters, loses or queues, whose machine wakes
late, stands still or is slow, whose bus others use, or whose nodes answer late.

Each is drawn from a seed: kind, rate of the cycle, and how bad, from not felt to hopeless.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from random import Random

from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.session.session import Session
from canprobe.fieldbus.bus.clock import Clock
from canprobe.fieldbus.bus.port import Port, TimedFrame
from canprobe.fieldbus.bus.tapped import OuterPort
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.protocol.frames import SYNC_ID, Frame
from canprobe.fieldbus.tools.faults.fault import FOREVER_NS

FRAME_NS = 130_000
"""Time of a frame of eight bytes at 1 Mbit/s."""
RATES_HZ = (100, 200, 400)
LOUD_ID = 0x120
"""Identifier of the frames of others: it wins against every PDO."""
RANGES = {
    "delay": (0.05, 1.0),
    "jitter": (0.005, 0.3),
    "loss": (1e-5, 0.02),
    "load": (0.03, 0.6),
    "node": (0.05, 1.0),
    "queue": (0.02, 1.0),
    "machine": (0.1, 3.0),
}
"""How bad a set-up may be: delays, scatter and sleeps in periods of the cycle; loss and load as shares."""
KINDS = ("clean", *RANGES)
MACHINES = {"machine": (0.2, 3.2), "still": (0.2, 3.2), "slow": (0.08, 0.8)}
"""Machines whose overruns at other rates are predicted: single wake-ups are late, all stands still now and then because
another process has the processor, or the work of a cycle takes long; sizes in periods of `MACHINE_HZ`."""
MACHINE_HZ = 400


@dataclass(frozen=True, slots=True)
class SetUp:
    """One constructed link.

    Attributes:
        seed: seed that all of it follows from.
        kind: what is wrong with it; also the cause that a check should name.
        rate_hz: rate of the cycle whose periods `size` counts.
        size: how bad it is, as in `RANGES` or `MACHINES`.
        share: of a late machine the share of the sleeps that end late; of one that stands still how often in a second.
        room: frames that its transmit queue holds; of a lossy link one more than the periods that a loss lasts.
        node_id: the node that answers late.
    """

    seed: int
    kind: str
    rate_hz: int
    size: float
    share: float
    room: int
    node_id: int


def draw_setup(seed: int) -> SetUp:
    """The set-up of a seed."""
    rng = Random(seed)
    kind = rng.choice(KINDS)
    low, high = RANGES.get(kind, (1.0, 1.0))
    size = math.exp(rng.uniform(math.log(low), math.log(high)))
    share = math.exp(rng.uniform(math.log(1e-3), math.log(0.3)))
    return SetUp(seed, kind, rng.choice(RATES_HZ), size, share, rng.randint(1, 8), rng.randint(1, 6))


def draw_machine(seed: int) -> SetUp:
    """The machine of a seed; the kinds take turns."""
    rng, kind = Random(seed), tuple(MACHINES)[seed % len(MACHINES)]
    low, high = MACHINES[kind]
    size = math.exp(rng.uniform(math.log(low), math.log(high)))
    share, per_s = math.exp(rng.uniform(-4.0, -1.5)), math.exp(rng.uniform(2.0, 4.0))
    return SetUp(seed, kind, MACHINE_HZ, size, per_s if kind == "still" else share, 1, 0)


def scene_at(rate_hz: float) -> Scene:
    """The scene `free` at a rate, on a bus whose frames take time."""
    return load_scene("free", {"cycle.rate_hz": rate_hz, "bus.timed": True, "outputs.figures": False})


def construct(session: Session, setup: SetUp, part: int) -> None:
    """Make a session's link that of a set-up, before the session is entered.

    Args:
        session: session in lockstep.
        setup: the set-up.
        part: number of the session among those of the set-up: each has other random numbers.
    """
    period_ns = round(1e9 / setup.rate_hz)
    if setup.kind == "node":
        faulty = session.buses.world.make_faulty()
        faulty.inject(f"node {setup.node_id}: delay ms={setup.size * period_ns * 1e-6:.6f}", 0)

    def around(port: Port) -> Port:
        if setup.kind == "load":
            assert session.buses.lockstep is not None
            session.buses.lockstep.attach(Loud(round(FRAME_NS / setup.size)))
        return DisturbedPort(port, setup, Random(setup.seed * 1000 + part))

    session.around = around


class Loud(Participant):
    """Sends a frame of eight bytes again and again.

    Args:
        period_ns: time from one to the next.
    """

    name = "somebody else"
    listens: Collection[int] = ()
    next_deadline_ns: int | None = 0

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns

    def advance(self, t_ns: int) -> Sequence[Frame]:
        """Send one frame."""
        self.next_deadline_ns = t_ns + self._period_ns
        return [(LOUD_ID, bytes(8))]


class DisturbedClock:
    """A clock whose sleeps end late.

    Args:
        clock: the clock behind it.
        rng: generator of the lateness.
        often: how often it happens.
        mean_ns: mean of how long it lasts.
    """

    def __init__(self, clock: Clock, rng: Random, often: float, mean_ns: float) -> None:
        self.clock, self.rng, self.often, self.mean_ns = clock, rng, often, mean_ns

    def now_ns(self) -> int:
        """Present time, ns."""
        return self.clock.now_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep, and now and then oversleep: `often` is the share of these sleeps."""
        if t_ns > self.clock.now_ns():
            self.clock.sleep_until_ns(t_ns)
            if self.rng.random() < self.often:
                self.clock.sleep_until_ns(t_ns + round(self.rng.expovariate(1.0 / self.mean_ns)))


class StandingClock(DisturbedClock):
    """A clock on a machine that stands still for some times, `often` in a second; a sleep ends behind such a time."""

    begin_ns = end_ns = 0

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep; a standstill goes on."""
        if t_ns <= self.clock.now_ns():
            return
        while self.end_ns < t_ns:
            self.begin_ns = self.end_ns + round(self.rng.expovariate(self.often * 1e-9))
            self.end_ns = self.begin_ns + round(self.rng.expovariate(1.0 / self.mean_ns))
        self.clock.sleep_until_ns(self.end_ns if self.begin_ns <= t_ns else t_ns)


class DisturbedPort(OuterPort):
    """A port that delays, scatters and loses frames, with a short transmit queue, a late clock or a slow master.

    Args:
        port: port of the virtual bus.
        setup: what is wrong.
        rng: generator of its chances.
    """

    stamps_arrival = True

    def __init__(self, port: Port, setup: SetUp, rng: Random) -> None:
        super().__init__(port)
        self._setup, self._rng = setup, rng
        self._period_ns = round(1e9 / setup.rate_hz)
        clocks = {"machine": DisturbedClock, "still": StandingClock}
        if setup.kind in clocks:
            self.clock = clocks[setup.kind](port.clock, rng, setup.share, setup.size * self._period_ns)
        self._arriving = deque[TimedFrame]()
        self._last_ns = self._sent_ns = self._lost_until_ns = 0

    def send_batch(self, frames: Sequence[Frame], t_ns: int | None = None) -> None:
        """Send frames, as far as they are not lost; a full queue is waited for."""
        kept = [frame for frame in frames if not self._is_lost()]
        if self._setup.kind != "queue":
            self._port.send_batch(kept, t_ns)
            if self._setup.kind == "slow" and len(frames) > 1 and all(can_id != SYNC_ID for can_id, _ in frames):
                self.clock.sleep_until_ns(self.clock.now_ns() + round(self._setup.size * self._period_ns))
            return
        for frame in kept:
            while self._sent_ns - self.clock.now_ns() > self._setup.room * FRAME_NS:
                self.counters.transmit_full += 1
                self.clock.sleep_until_ns(self.clock.now_ns() + round(self._setup.size * self._period_ns))
            self._sent_ns = max(self._sent_ns, self.clock.now_ns()) + FRAME_NS
            self._port.send_batch([frame])

    def drain(self) -> list[TimedFrame]:
        """Return the frames that have arrived."""
        self._take()
        arrived, now_ns = list[TimedFrame](), self.clock.now_ns()
        while self._next_ns() <= now_ns:
            arrived.append(self._arriving.popleft())
        return arrived

    def wait(self, until_ns: int) -> None:
        """Wait for a frame, until `until_ns` at the latest."""
        self._take()
        while self.clock.now_ns() < min(until_ns, self._next_ns()):
            self._port.wait(min(until_ns, self._next_ns()))
            self._take()

    def _next_ns(self) -> int:
        """Time of the next arrival, ns; of none that is known far away."""
        return self._arriving[0][2] if self._arriving else FOREVER_NS

    def _is_lost(self) -> bool:
        """Whether a frame falls into a loss: each begins with a frame, and lasts for some periods or for that frame."""
        if self._setup.kind != "loss":
            return False
        now_ns = self.clock.now_ns()
        if now_ns >= self._lost_until_ns:
            if self._rng.random() >= self._setup.size:
                return False
            self._lost_until_ns = now_ns + (self._setup.room - 1) * self._period_ns
        return True

    def _take(self) -> None:
        kind = self._setup.kind
        for can_id, data, t_ns in self._port.drain():
            if self._is_lost():
                continue
            delay_ns = self._setup.size * self._period_ns if kind in ("delay", "jitter") else 0.0
            if kind == "jitter":
                delay_ns = self._rng.expovariate(1.0 / delay_ns)
            self._last_ns = max(self._last_ns, t_ns + round(delay_ns))  # an adapter keeps the order
            self._arriving.append((can_id, data, self._last_ns))
