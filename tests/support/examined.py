"""A device under examination on a lockstep bus, and what the bench sends to it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from canprobe.fieldbus.bus.candump import RecordingPort
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.port import ControllerState
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus, Participant
from canprobe.fieldbus.drive.from_eds import make_eds_node
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.tools.conform import POINTS, Examination, ExaminationSettings, Point
from canprobe.fieldbus.tools.reports import Report, Verdict

NODE_ID = 5


class WatchedPort(RecordingPort):
    """A port that notes what is sent, calls a function before each frame with their number, and may be bus off."""

    def __init__(self, port: Any, before: Callable[[int], object] = lambda count: None) -> None:
        super().__init__(port, lambda *_: None)
        self.sent: list[tuple[int, bytes]] = []
        self.before = before
        self.off_until_ns = 0

    @property
    def state(self) -> ControllerState:
        off = self.clock.now_ns() < self.off_until_ns
        return ControllerState.BUS_OFF if off else ControllerState.ACTIVE

    def send_batch(self, frames: Any, t_ns: int | None = None) -> None:
        for frame in frames:
            self.before(len(self.sent))
            self.sent.append(frame)
        super().send_batch(frames, t_ns)


class Examined:
    """One device on a bus, and the port of its bench.

    Args:
        node: the device.
        od: its object dictionary; None: the bench has no EDS.
        wrap: what stands between the device and the bus.
        others: other devices on the bus.
        bus: the bus; a lockstep bus with CAN FD by default.
    """

    def __init__(
        self,
        node: SlaveNode,
        od: Any,
        *,
        wrap: Callable[[SlaveNode], Participant] = lambda node: node,
        others: Sequence[Participant] = (),
        bus: LockstepBus | None = None,
    ) -> None:
        self.node, self.description = node, None if od is None else Description(od)
        self.bus = bus or LockstepBus(VirtualClock(), fd=True)
        self.participant = wrap(node)
        for participant in (self.participant, *others):
            self.bus.attach(participant)
        self.port = WatchedPort(self.bus.port())

    def run(self, settings: ExaminationSettings | None = None, points: Sequence[Point] = POINTS) -> Report:
        """Examine it."""
        return Examination(self.port, NODE_ID, self.description, settings).run(points)

    def switch(self, _question: str = "") -> bool:
        """Take the device's power and give it back, as somebody who is asked to."""
        self.bus.detach(self.participant)
        self.bus.attach(self.participant)
        return True

    @property
    def values(self) -> dict[int, object]:
        """Values of the communication area by key, but for those that the device makes itself."""
        return {
            key: value
            for key, value in self.node.dictionary.values.items()
            if 0x1000 <= key >> 8 < 0x2000 and key >> 8 not in (0x1001, 0x1003)
        }


def eds_device(name: str | Path = "puma260_joint", *, described: bool = True, **more: Any) -> Examined:
    """The emulated node of an EDS; the bench has the EDS, unless it is not `described`."""
    od = load_eds(name, NODE_ID)
    return Examined(make_eds_node(od, NODE_ID, eds=name), od if described else None, **more)


def failed(report: Report) -> dict[str, str]:
    """Points that failed or ended with an error, with what was wrong."""
    bad = (Verdict.FAIL, Verdict.ERROR)
    return {f"{row.group} {row.name}": row.detail for row in report.rows if row.verdict in bad}
