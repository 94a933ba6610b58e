"""Record of a run's buses: their traffic counted, written into ``bus.log`` and shown to the observers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Self

from canprobe.cell.master.observers import Observers
from canprobe.cell.planning.measured import TrafficMeter
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.wire_time import unstuffed_frame_bits
from canprobe.cell.scene.hardware import BusSettings
from canprobe.cell.session.folder import prepare_folder
from canprobe.cell.session.target import LOCKSTEP
from canprobe.fieldbus.bus.candump import CandumpWriter
from canprobe.fieldbus.bus.clock import Clock
from canprobe.fieldbus.bus.files import make_folder
from canprobe.fieldbus.bus.port import TimedFrame, is_bus_error

Write = Callable[[int, bytes, int], None]


class TrafficCounter:
    """Counts frames and bits of a bus in real time; bits without stuffing, as `canbusload -i` counts.

    Args:
        bus: bit rates of the bus.

    Attributes:
        error_frames: number of bus errors; whoever receives one counts it here.
    """

    def __init__(self, bus: BusSettings) -> None:
        self._by_length = [0] * 65
        self._bus = bus
        self.error_frames = 0

    @property
    def frames(self) -> int:
        """Number of frames so far."""
        return sum(self._by_length)

    @property
    def bits(self) -> int:
        """Number of bits so far, those of a data phase in bits of the nominal rate."""
        counted = enumerate(self._by_length)
        return sum(count * unstuffed_frame_bits(n, self._bus) for n, count in counted if count)

    def write(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Count one frame."""
        self._by_length[len(data)] += 1

    def take(self, frames: Sequence[TimedFrame]) -> None:
        """Count several frames."""
        for _, data, _ in frames:
            self._by_length[len(data)] += 1


class BusRecord:
    """Record of every bus of a run. A context manager: leaving closes ``bus.log``.

    Args:
        plan: plan of the run.
        out: folder for ``bus.log``, which the first `writer` prepares; None writes nothing.
        observers: observers that get the frames; None where there are none.

    Attributes:
        origin_ns: time on the clock of the buses from which the log counts.
        traffic: counter of each channel.
        meters: meters of a lockstep bus, which compare the traffic with the plan during the run; on a real bus
            the log is compared afterwards.
    """

    def __init__(self, plan: Plan, out: Path | None, observers: Observers | None) -> None:
        self.origin_ns = 0
        self.traffic: dict[str, TrafficCounter | TrafficMeter] = {}
        self.meters: dict[str, TrafficMeter] = {}
        self._plan = plan
        self._out = out
        self._observers = observers
        self._candump: CandumpWriter | None = None
        self._writers: dict[str, Write] = {}
        self._time_ns = 0
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def writer(self, channel: str) -> Write:
        """Make the function that takes each frame of a bus; a bus that is opened again has the same one."""
        if channel not in self._writers:
            self._writers[channel] = self._make_writer(channel)
        return self._writers[channel]

    def _make_writer(self, channel: str) -> Write:
        bus = self._plan.scene.bus
        if bus.interface == LOCKSTEP:
            self.traffic[channel] = self.meters[channel] = TrafficMeter(self._plan, channel, exact=False)
        else:
            self.traffic[channel] = TrafficCounter(bus)
        write: Write = self.traffic[channel].write
        if self._out is not None:
            if self._candump is None:
                make_folder(self._out)
                log = CandumpWriter(self._out / "bus.log", channel, self.origin_ns)
                self._candump = self._stack.enter_context(log)
                prepare_folder(self._plan, self._out)
            write = self._candump.on(channel, self.traffic[channel].take)
        if self._observers is not None:
            self._observers.origin_ns = self.origin_ns
            write = self._observers.tap(write)
        return write

    def error_writer(self, channel: str) -> Write:
        """Make the function that counts each error frame of a bus and writes it into the log."""

        def note(can_id: int, data: bytes, t_ns: int) -> None:
            self.traffic[channel].error_frames += is_bus_error(can_id)
            if self._candump is not None:
                self._candump.on(channel)(can_id, data, t_ns)

        return note

    def failure(self) -> str | None:
        """Why frames are no longer written into the log; None while they are."""
        return self._candump.failure if self._candump is not None else None

    @contextmanager
    def timed(self, clock: Clock) -> Iterator[None]:
        """Measure the time over which the loads are taken."""
        start_ns = clock.now_ns()
        try:
            yield
        finally:
            self._time_ns = clock.now_ns() - start_ns

    def load(self, channel: str) -> float | None:
        """Measured load, a share of the bit rate; None where nothing was measured."""
        if channel not in self.traffic or self._time_ns <= 0:
            return None
        return self.traffic[channel].bits / (self._plan.scene.bus.bitrate * self._time_ns * 1e-9)
