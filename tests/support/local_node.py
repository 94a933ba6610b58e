"""canopen-python's LocalNode on a lockstep bus: it receives, answers and sends its heartbeat in virtual time.

`python tests/support/local_node.py` prints what `conform` finds in it, as docs/measure.py wants it.
"""

from __future__ import annotations

import importlib.metadata
import json
import logging
from collections.abc import Sequence
from typing import Any

import canopen

from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus, Participant
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.tools.conform import Examination, ExaminationSettings
from canprobe.fieldbus.tools.reports import Report, Verdict


class _Periodic:
    """What canopen gets for a frame that it wants to be sent again and again."""

    def __init__(self, tasks: list[_Periodic], can_id: int, data: bytes, period_s: float, t_ns: int) -> None:
        self.can_id, self.data, self.period_ns = can_id, bytes(data), round(period_s * 1e9)
        self.due_ns = t_ns
        self._tasks = tasks
        tasks.append(self)

    def stop(self) -> None:
        self._tasks.remove(self)

    def update(self, data: bytes) -> None:
        self.data = bytes(data)


class _Network(canopen.Network):
    def __init__(self, owner: LocalNodeOnBus) -> None:
        super().__init__()
        self._owner = owner

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._owner.out.append((can_id, bytes(data)))

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> Any:
        return _Periodic(self._owner.tasks, can_id, data, period, self._owner.t_ns)

    def check(self) -> None:
        """There is no thread that could have failed."""


class LocalNodeOnBus(Participant):
    """The node. It boots when it is attached, and is pre-operational then."""

    name = "LocalNode"

    def __init__(self, node_id: int, od: Any) -> None:
        self.out: list[Frame] = []
        self.tasks: list[_Periodic] = []
        self.t_ns = 0
        self.network = _Network(self)
        self.node = canopen.LocalNode(node_id, od)
        self.node.associate_network(self.network)

    @property
    def next_deadline_ns(self) -> int | None:
        return min((task.due_ns for task in self.tasks), default=None)

    def start(self, t_ns: int) -> Sequence[Frame]:
        self.node.nmt.send_command(0x81)
        self.node.nmt.send_command(0x80)
        return self._sent()

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        self.t_ns = t_ns
        if can_id < 0x800:
            try:
                self.network.notify(can_id, bytearray(data), t_ns * 1e-9)
            except Exception:  # its thread logs it and goes on
                logging.getLogger(__name__).debug("LocalNode raises", exc_info=True)
        return self._sent()

    def advance(self, t_ns: int) -> Sequence[Frame]:
        self.t_ns = t_ns
        for task in self.tasks:
            if task.due_ns <= t_ns:
                self.out.append((task.can_id, task.data))
                task.due_ns = t_ns + task.period_ns
        return self._sent()

    def _sent(self) -> list[Frame]:
        sent, self.out = self.out, []
        return sent


def examined(node_id: int = 5) -> Report:
    """The examination of a LocalNode with the EDS of our drives."""
    od = load_eds("puma260_joint", node_id)
    bus = LockstepBus(VirtualClock(), fd=True)
    bus.attach(LocalNodeOnBus(node_id, od))
    logging.disable(logging.CRITICAL)
    try:
        return Examination(bus.port(), node_id, Description(od), ExaminationSettings(fd=True)).run()
    finally:
        logging.disable(logging.NOTSET)


if __name__ == "__main__":
    report = examined()
    counts = {verdict: number for verdict, number in report.counts().items()}
    rows = [[row.clause, f"{row.group} {row.name}", row.detail] for row in report.rows if row.verdict is Verdict.FAIL]
    version = importlib.metadata.version("canopen")
    table = [["clause", "point", "what it does"], *sorted(rows, key=lambda row: row[0])]
    found = f"canopen {version}: " + ", ".join(f"{number} {verdict}" for verdict, number in counts.items())
    print(json.dumps({"table": table, "findings": [found]}))
