"""canopen-python's LocalNode on a lockstep bus: it receives, answers and sends its heartbeat in virtual time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import canopen

from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.protocol.frames import Frame


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
                self.failures = True
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
