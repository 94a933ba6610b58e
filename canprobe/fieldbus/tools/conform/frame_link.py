"""The frames between the bench and the device: sent through one gate, received with their time, sorted, and recorded.

Nothing else of the examination touches the bus. While somebody waits, the background load is sent on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from canprobe.fieldbus.bus.port import ControllerState, Port, TimedFrame
from canprobe.fieldbus.protocol.emcy import Emcy
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, SDO_RX_BASE, SDO_TX_BASE, Frame
from canprobe.fieldbus.protocol.sdo import Place
from canprobe.fieldbus.tools.conform.outcome import BenchFailure
from canprobe.fieldbus.tools.conform.permits import Permits
from canprobe.fieldbus.tools.conform.surroundings import MAX_BASE_ID

_KEPT_FRAMES = 12
"""Frames of each direction that the report of a point shows, the last ones."""
_KEPT_INBOX = 20_000
_EMCY_BYTES = 8


@dataclass(frozen=True, slots=True)
class BenchTimes:
    """How long the bench waits, s.

    Attributes:
        sdo_s: for an SDO answer.
        boot_s: for a boot-up.
        silence_s: for a reaction that must not come.
        slack_s: what the machine and the bus may add to a time.
    """

    sdo_s: float = 1.0
    boot_s: float = 5.0
    silence_s: float = 0.05
    slack_s: float = 0.02


class CameFrame(NamedTuple):
    """A frame that came.

    Attributes:
        can_id: identifier, with the flags of `port`.
        data: its data.
        t_ns: time of its reception.
    """

    can_id: int
    data: bytes
    t_ns: int


class FrameLink:
    """Frames to and from one device.

    Args:
        port: connection to the bus.
        node_id: id of the device.
        permits: gate for what is sent.
        times: how long is waited.

    Attributes:
        emcy_id: identifier of the device's EMCY.
        request_id, answer_id, beat_id: identifiers of the SDO requests to the device, of its answers, of its heartbeat.
        emergencies: EMCY messages that nobody has taken yet, with their times.
        boots: number of boot-ups so far.
        odd_ids: identifiers, with their flags, of remote requests and frames with 29 bits that came.
        noted: function that is called with each entry before it is written.
        sent, came: last frames in each direction.
        load: frames of the background load and the time between two of them, ns; None: there is none.
    """

    def __init__(self, port: Port, node_id: int, permits: Permits, times: BenchTimes) -> None:
        self.port, self.node_id, self.permits, self.times = port, node_id, permits, times
        self.emcy_id, self.beat_id = EMCY_BASE + node_id, HEARTBEAT_BASE + node_id
        self.request_id, self.answer_id = SDO_RX_BASE + node_id, SDO_TX_BASE + node_id
        self.emergencies: deque[tuple[Emcy, int]] = deque()
        self.boots = 0
        self.odd_ids: set[int] = set()
        self.noted: Callable[[Place], None] = lambda _: None
        self.load: tuple[Sequence[Frame], int] | None = None
        self.sent: deque[Frame] = deque(maxlen=_KEPT_FRAMES)
        self.came: deque[Frame] = deque(maxlen=_KEPT_FRAMES)
        self._inbox: dict[int, deque[CameFrame]] = {}
        self._next_load_ns = 0
        self._load_count = 0

    @property
    def now_ns(self) -> int:
        """Present time of the bus, ns."""
        return self.port.clock.now_ns()

    def send(self, can_id: int, data: bytes = b"", *, segment: bool = False) -> int:
        """Send a frame; return when.

        Args:
            can_id: identifier, with the flags of `port`.
            data: its data.
            segment: whether it is a segment of a block download, which may look like any request.

        Raises:
            NotPermitted: it must not be sent here.
        """
        place = None if segment else self.permits.check(can_id, data)
        if place is not None:
            self.noted(place)
        t_ns = self.now_ns
        self.sent.append((can_id, data))
        self.port.send_batch([(can_id, data)])
        return t_ns

    def pass_time(self, seconds: float) -> None:
        """Let time pass, and receive what comes."""
        self._receive(self.now_ns + round(seconds * 1e9))

    def next(self, can_id: int, within_s: float) -> CameFrame | None:
        """The next frame with an identifier that was not taken yet; None where none comes in time."""
        until_ns = self.now_ns + round(within_s * 1e9)
        box = self._inbox.setdefault(can_id, deque())
        self._receive(self.now_ns)
        while not box and self.now_ns < until_ns:
            self._receive(until_ns, once=True)
        return box.popleft() if box else None

    def coming(self, can_id: int, within_s: float) -> Iterator[CameFrame]:
        """Frames with an identifier, as they come, until a time is over."""
        until_ns = self.now_ns + round(within_s * 1e9)
        while (frame := self.next(can_id, max(0, until_ns - self.now_ns) * 1e-9)) is not None:
            yield frame

    def taken(self, can_id: int) -> list[CameFrame]:
        """Frames with an identifier that came and were not taken yet; they are taken now."""
        self._receive(self.now_ns)
        return list(self._inbox.pop(can_id, ()))

    def during(self, seconds: float, can_id: int) -> list[CameFrame]:
        """Frames with an identifier that come from now on for some time."""
        self.taken(can_id)
        self.pass_time(seconds)
        return self.taken(can_id)

    def forget(self) -> None:
        """Drop all frames that nobody took, and begin a new record."""
        self._receive(self.now_ns)
        self._inbox.clear()
        self.sent.clear()
        self.came.clear()

    def _receive(self, until_ns: int, *, once: bool = False) -> None:
        """Receive until a time; with `once` no longer than until something came."""
        while True:
            if self.port.state is ControllerState.BUS_OFF:
                raise BenchFailure(f"{self.port.channel}: the controller of this machine is bus off")
            frames = self.port.drain()
            for frame in frames:
                self._sort(frame)
            now_ns = self.now_ns
            if now_ns >= until_ns or (once and frames):
                return
            self.port.wait(until_ns if self.load is None else min(until_ns, self._load_due(now_ns)))

    def _load_due(self, now_ns: int) -> int:
        """Send what is due of the background load; return when the next is."""
        assert self.load is not None
        frames, gap_ns = self.load
        self._next_load_ns = max(self._next_load_ns, now_ns - 20 * gap_ns)
        while self._next_load_ns <= now_ns:
            frame = frames[self._load_count % len(frames)]
            self.permits.check(*frame)
            self.port.send_batch([frame])
            self._load_count += 1
            self._next_load_ns += gap_ns
        return self._next_load_ns

    def _sort(self, frame: TimedFrame) -> None:
        can_id, data, t_ns = frame
        if can_id == self.emcy_id and len(data) == _EMCY_BYTES:
            self.emergencies.append((Emcy.unpack(data), t_ns))
        elif can_id == self.beat_id and data == b"\0":
            self.boots += 1
        if can_id > MAX_BASE_ID:
            self.odd_ids.add(can_id)
        if can_id & 0x7F == self.node_id or can_id > MAX_BASE_ID:
            self.came.append((can_id, data))
        self._inbox.setdefault(can_id, deque(maxlen=_KEPT_INBOX)).append(CameFrame(*frame))
