"""A measurement of test_bench_side_by_side.py, in a process: `python side_by_side_child.py KIND` prints µs a cycle."""

from __future__ import annotations

import json
import sys
import tempfile
import threading
from collections.abc import Callable
from time import process_time, thread_time
from typing import Any

import can
import canopen

import canprobe
from canprobe.fieldbus import load_eds

CYCLES, WARM_UP = 4000, 400
DRIVES = range(1, 7)
THE_END = 0x7FF


def cell(bus: str) -> float:
    """A cycle of the whole cell."""
    marks: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        canprobe.run(
            "cylinder", {"scene.figures": False, "shape.also": []}, bus=bus, duration_s=CYCLES / 400,
            out=f"{folder}/run", progress=lambda *_: marks.append(process_time()),
        )  # fmt: skip
    return (marks[-1] - marks[WARM_UP]) / (len(marks) - 1 - WARM_UP)


def with_pdos(network: canopen.Network, make: Callable[[int, Any], Any]) -> list[Any]:
    """Six nodes of a network, with three variables in their TPDO and two in their RPDO."""
    nodes = [network.add_node(make(node_id, load_eds("puma260_joint", node_id))) for node_id in DRIVES]
    for node in nodes:
        for pdo, base, variables in (
            (node.tpdo[1], 0x180, (0x6041, 0x6064, 0x6077)),
            (node.rpdo[1], 0x200, (0x6040, 0x607A)),
        ):
            pdo.clear()
            for index in variables:
                pdo.add_variable(index)
            pdo.cob_id, pdo.enabled = base + node.id, True
            pdo.subscribe()
    return nodes


def by_place(node: Any) -> tuple[list[Any], list[Any]]:
    """The variables of a node's TPDO and RPDO, in the way that costs least."""
    return list(node.tpdo[1]), list(node.rpdo[1])


def by_name(node: Any) -> tuple[list[Any], list[Any]]:
    """The same variables as canopen-python's documentation asks for them, one by one by their names."""
    return (
        [node.tpdo[1][name] for name in ("Statusword", "Position actual value", "Torque actual value")],
        [node.rpdo[1][name] for name in ("Controlword", "Target position")],
    )


Variables = Callable[[Any], tuple[list[Any], list[Any]]]


class ReadyMadeDrives:
    """The far end as ready-made bytes, six of them at each SYNC; `used_s` is the processor time of its thread."""

    def __init__(self) -> None:
        self.used_s = 0.0
        self._bus = can.Bus(interface="virtual", channel="side")
        self._answers = [can.Message(arbitration_id=0x180 + i, data=bytes(8), is_extended_id=False) for i in DRIVES]
        self._thread = threading.Thread(target=self._answer)
        self._thread.start()

    def _answer(self) -> None:
        while (message := self._bus.recv()).arbitration_id != THE_END:
            for answer in self._answers if message.arbitration_id == 0x80 else ():
                self._bus.send(answer)
            self.used_s = thread_time()

    def end(self) -> None:
        """Wait for its thread, which ends with the frame `THE_END`."""
        self._thread.join()
        self._bus.shutdown()


class CanopenDrives:
    """The far end as six `LocalNode` of canopen-python, which hold their targets; its time is part of the cycle's."""

    used_s = 0.0

    def __init__(self, variables: Variables) -> None:
        self._variables = variables
        self._network = canopen.Network()
        self._network.connect(interface="virtual", channel="side")
        self._nodes = with_pdos(self._network, canopen.LocalNode)
        self._network.subscribe(0x80, self._answer)

    def _answer(self, *_: Any) -> None:
        for node in self._nodes:
            (state, position, torque), (_, target) = self._variables(node)
            state.raw, position.raw, torque.raw = 0x27, target.raw, 0
            node.tpdo[1].transmit()

    def end(self) -> None:
        """Close its bus."""
        self._network.disconnect()


def master(drives: ReadyMadeDrives | CanopenDrives, variables: Variables) -> float:
    """A cycle of canopen-python's master, with its thread as `connect` gives it."""
    network = canopen.Network()
    network.connect(interface="virtual", channel="side")
    nodes = with_pdos(network, canopen.RemoteNode)
    began = 0.0
    for cycle in range(WARM_UP + CYCLES):
        began = process_time() - drives.used_s if cycle == WARM_UP else began
        for node in nodes:
            node.tpdo[1].is_received = False
        network.sync.transmit(cycle % 240 + 1)
        for node in nodes:
            with node.tpdo[1].receive_condition:
                while not node.tpdo[1].is_received:
                    node.tpdo[1].receive_condition.wait(1.0)
        for node in nodes:
            feedback, (controlword, target) = variables(node)
            _, position, _ = [variable.raw for variable in feedback]
            controlword.raw, target.raw = 0x0F, position
            node.rpdo[1].transmit()
    used = process_time() - drives.used_s - began
    network.send_message(THE_END, b"")
    drives.end()
    network.disconnect()
    return used / CYCLES


def virtual_bus() -> float:
    """The 13 frames of that cycle through python-can's virtual bus."""
    one, other = (can.Bus(interface="virtual", channel="side") for _ in range(2))
    began = 0.0
    for cycle in range(WARM_UP + CYCLES):
        began = process_time() if cycle == WARM_UP else began
        one.send(can.Message(arbitration_id=0x80, data=bytes((cycle % 240 + 1,)), is_extended_id=False))
        other.recv(1.0)
        for sender, receiver, base in ((other, one, 0x180), (one, other, 0x200)):
            for node_id in DRIVES:
                sender.send(can.Message(arbitration_id=base + node_id, data=bytes(8), is_extended_id=False))
                receiver.recv(1.0)
    used = process_time() - began
    one.shutdown()
    other.shutdown()
    return used / CYCLES


if __name__ == "__main__":
    kind = sys.argv[1]
    others = {
        "canopen-python": lambda: master(ReadyMadeDrives(), by_place),
        "canopen-python, by name": lambda: master(ReadyMadeDrives(), by_name),
        "canopen-python, both ends": lambda: master(CanopenDrives(by_place), by_place),
        "canopen-python, both ends, by name": lambda: master(CanopenDrives(by_name), by_name),
        "virtual bus": virtual_bus,
    }
    print(json.dumps(1e6 * (others[kind]() if kind in others else cell(kind))))
