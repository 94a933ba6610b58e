"""A measurement of test_bench_side_by_side.py, in a process: `python side_by_side_child.py KIND` prints µs a cycle."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import process_time
from typing import Any

import can
import canopen

import canprobe
from canprobe.fieldbus import load_eds

CYCLES, WARM_UP = 4000, 400
DRIVES, ARRAY = range(1, 7), 16
WINDOW = {1: (0x2120, 0)} | {2 + k: (0x2110, 1 + k) for k in range(8)}
"""Place in the dictionary of what each TPDO of the array carries: the header, and the window of 8 × 8 taxels."""
IMAGE_CYCLES = 2
NAMES: dict[int, list[str]] = {}
"""Names of the variables of each PDO, by its COB-ID."""


def cell(bus: str) -> float:
    """A cycle of the whole cell."""
    marks: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        canprobe.run(
            "cylinder", {"outputs.figures": False, "shape.also": []}, bus=bus, duration_s=CYCLES / 400,
            out=f"{folder}/run", progress=lambda *_: marks.append(process_time()),
        )  # fmt: skip
    return (marks[-1] - marks[WARM_UP]) / (len(marks) - 1 - WARM_UP)


def with_pdos(network: canopen.Network, make: Callable[[int, Any], Any]) -> tuple[list[Any], Any]:
    """Six drives of a network, with three variables in their TPDO and two in their RPDO, and an array's window."""
    drives = [network.add_node(make(node_id, load_eds("puma260_joint", node_id))) for node_id in DRIVES]
    for node in drives:
        add_pdo(node.tpdo[1], 0x180 + node.id, [(0x6041, 0), (0x6064, 0), (0x6077, 0)])
        add_pdo(node.rpdo[1], 0x200 + node.id, [(0x6040, 0), (0x607A, 0)])
    array = network.add_node(make(ARRAY, load_eds("tactile_array", ARRAY)))
    for number, place in WINDOW.items():
        add_pdo(array.tpdo[number], 0x510 + number, [place])
    return drives, array


def add_pdo(pdo: Any, cob_id: int, variables: list[tuple[int, int]]) -> None:
    """A PDO with variables at these places of the dictionary."""
    pdo.clear()
    for index, subindex in variables:
        pdo.add_variable(index, subindex)
    NAMES[cob_id] = [variable.name for variable in pdo]
    pdo.cob_id, pdo.enabled = cob_id, True
    pdo.subscribe()


def by_place(pdo: Any) -> list[Any]:
    """The variables of a PDO, in the way that costs least."""
    return list(pdo)


def by_name(pdo: Any) -> list[Any]:
    """The same variables as canopen-python's documentation asks for them, one by one by their names."""
    return [pdo[name] for name in NAMES[pdo.cob_id]]


Variables = Callable[[Any], list[Any]]


class CanopenNodes:
    """The far end: six `LocalNode` that hold their targets, and one whose image comes with every second SYNC."""

    def __init__(self, variables: Variables) -> None:
        self._variables, self._syncs = variables, 0
        self._network = canopen.Network()
        self._network.connect(interface="virtual", channel="side")
        self._drives, self._array = with_pdos(self._network, canopen.LocalNode)
        self._network.subscribe(0x80, self._answer)

    def _answer(self, *_: Any) -> None:
        for node in self._drives:
            state, position, torque = self._variables(node.tpdo[1])
            _, target = self._variables(node.rpdo[1])
            state.raw, position.raw, torque.raw = 0x27, target.raw, 0
            node.tpdo[1].transmit()
        self._syncs += 1
        for number in WINDOW if self._syncs % IMAGE_CYCLES == 0 else ():
            pdo = self._array.tpdo[number]
            (taxels,) = self._variables(pdo)
            taxels.raw = self._syncs
            pdo.transmit()

    def end(self) -> None:
        """Close its bus."""
        self._network.disconnect()


def master(variables: Variables) -> float:
    """A cycle of canopen-python at both ends, each with its thread as `connect` gives it."""
    far = CanopenNodes(variables)
    network = canopen.Network()
    network.connect(interface="virtual", channel="side")
    drives, array = with_pdos(network, canopen.RemoteNode)
    feedback = [node.tpdo[1] for node in drives]
    image = [array.tpdo[number] for number in WINDOW]
    began = 0.0
    for cycle in range(1, WARM_UP + CYCLES + 1):
        began = process_time() if cycle == WARM_UP + 1 else began
        awaited = feedback + (image if cycle % IMAGE_CYCLES == 0 else [])
        for pdo in awaited:
            pdo.is_received = False
        network.sync.transmit(cycle % 240 + 1)
        for pdo in awaited:
            with pdo.receive_condition:
                while not pdo.is_received:
                    pdo.receive_condition.wait(1.0)
        for pdo in awaited[len(feedback) :]:
            _ = [variable.raw for variable in variables(pdo)]
        for node in drives:
            _, position, _ = [variable.raw for variable in variables(node.tpdo[1])]
            controlword, target = variables(node.rpdo[1])
            controlword.raw, target.raw = 0x0F, position
            node.rpdo[1].transmit()
    used = process_time() - began
    far.end()
    network.disconnect()
    return used / CYCLES


def virtual_bus() -> float:
    """The 13 frames of that cycle, and 9 in every second, through python-can's virtual bus."""
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
        for number in WINDOW if cycle % IMAGE_CYCLES else ():
            other.send(can.Message(arbitration_id=0x510 + number, data=bytes(8), is_extended_id=False))
            one.recv(1.0)
    used = process_time() - began
    one.shutdown()
    other.shutdown()
    return used / CYCLES


def touch_grid() -> float:
    """A step of MuJoCo of an arm of six joints that rests on a ball, with a touch grid of 16 × 16 on its end."""
    import mujoco

    for library in Path(mujoco.__file__).with_name("plugin").glob("*sensor*"):
        mujoco.mj_loadPluginLibrary(str(library))
    arm = '<geom type="sphere" size="0.04" mass="0.3"/><site name="pad"/>'
    for number, axis in enumerate(("1 0 0", "0 1 0", "1 0 0", "0 1 0", "0 1 0", "0 0 1")):
        link = '<geom type="capsule" size="0.01" fromto="0 0 0 0.1 0 0" mass="0.3" contype="0" conaffinity="0"/>'
        joint = f'<joint name="{number}" axis="{axis}" damping="0.5" armature="0.05"/>'
        arm = f'{joint}{link}<body pos="0.1 0 0">{arm}</body>'
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><extension><plugin plugin="mujoco.sensor.touch_grid"/></extension><option timestep="0.0025"/>
        <worldbody><geom type="sphere" size="0.05" pos="0.6 0 0.01"/><body pos="0 0 0.1">{arm}</body></worldbody>
        <actuator>{"".join(f'<position joint="{number}" kp="200"/>' for number in range(6))}</actuator>
        <sensor><plugin plugin="mujoco.sensor.touch_grid" objtype="site" objname="pad">
        <config key="size" value="16 16"/><config key="fov" value="60 60"/>
        <config key="gamma" value="0"/><config key="nchannel" value="1"/></plugin>
        </sensor></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, WARM_UP)
    began = process_time()
    for _ in range(CYCLES):
        mujoco.mj_step(model, data)
    used = process_time() - began
    assert data.sensordata.sum() > 0.0  # it is pressed
    return used / CYCLES


if __name__ == "__main__":
    kind = sys.argv[1]
    others = {
        "canopen-python": lambda: master(by_place),
        "canopen-python, by name": lambda: master(by_name),
        "virtual bus": virtual_bus,
        "MuJoCo, touch grid": touch_grid,
    }
    print(json.dumps(1e6 * (others[kind]() if kind in others else cell(kind))))
