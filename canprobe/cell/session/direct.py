"""A cycle without a bus: it exchanges counts and images with emulated nodes, in the place of frames.

The nodes are those of a lockstep bus, with their drives, array, plant and PDO parameters, and everything happens in the
order and at the instants of a lockstep bus whose frames take no time: at a SYNC targets are latched, then positions and
images are sampled; controlwords that go on change act when the commands are sent. So log and truth are the same to the
last bit. Left out is what lies between: packing, frames and their arbitration, SDO, the log of the bus.

Heartbeats and emergencies, which a node sends by itself, are handed over unchanged: the supervision is that of a bus.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.emulated.array import TactileApplication
from canprobe.cell.emulated.world import World
from canprobe.cell.master.bringup import HEARTBEAT_CONSUMER
from canprobe.cell.master.cycle import Cycle
from canprobe.cell.master.tactile_frame import TactileFrame, covered, frame_of
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.node_configuration import NodeConfiguration, Write
from canprobe.fieldbus.bus.port import Port, nothing
from canprobe.fieldbus.bus.presence import SECOND_ANSWER_S
from canprobe.fieldbus.node.core import NodeCore
from canprobe.fieldbus.node.dictionary import Dictionary
from canprobe.fieldbus.node.rpdo import Rpdo
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.cia402 import INTERPOLATION_TIME
from canprobe.fieldbus.protocol.frames import SYNC_ID, Frame, NmtCommand, pack_nmt
from canprobe.fieldbus.protocol.sdo import SdoAbort
from canprobe.fieldbus.protocol.tactile import Features, TactileHeader

if TYPE_CHECKING:
    from canprobe.cell.master.array import TactileReceiver
    from canprobe.fieldbus.drive.drive import DriveApplication


def tactile_frame(
    header: TactileHeader, content: NDArray[np.uint8] | Features, shape: tuple[int, int], t_ns: int
) -> TactileFrame:
    """The frame that the master receives: the taxels that it carries, or the features as rounded on the wire.

    Args:
        header: header of the frame.
        content: image of the full pad, or features.
        shape: rows and columns of the pad.
        t_ns: time of its arrival.
    """
    if isinstance(content, Features):
        return frame_of(header, Features.unpack(content.pack(), content.peak), shape, t_ns)
    row, col, rows, columns = covered(header, shape)
    return frame_of(header, content[row : row + rows, col : col + columns], shape, t_ns)


def configure(node: SlaveNode, setup: NodeConfiguration) -> None:
    """Write a node's configuration into its dictionary, as bring-up does by SDO.

    Raises:
        NodeError: when the node refuses a required value.
    """
    times = [[write for write in setup.writes if write.index == INTERPOLATION_TIME], *setup.otherwise]
    for write in setup.writes:
        if write.index == HEARTBEAT_CONSUMER:
            continue
        if write.index != INTERPOLATION_TIME:
            taken = _takes(node.dictionary, write) or write.absence is not None
        else:
            taken = write is not times[0][0] or any(all(_takes(node.dictionary, w) for w in time) for time in times)
        if not taken:
            raise setup.error(f"refuses {write.place} = {write.value:#x} ({write.purpose})")


def _takes(dictionary: Dictionary, write: Write) -> bool:
    """Whether a node takes a value, or that value with the bits that the device sets, or holds it already."""
    held = dictionary.number(write.index, write.subindex)
    for value in (write.value, write.value & ~write.own_bits | held & write.own_bits):
        try:
            dictionary.write_value(dictionary.find_writable(write.index, write.subindex), value)
        except SdoAbort:
            if held == value and write.read_back:
                return True
        else:
            return True
    return False


class DirectCycle(Cycle):
    """A cycle whose SYNC, TPDOs and RPDOs are calls of emulated nodes; for its other arguments see `Cycle`.

    Args:
        world: the world with all nodes of the plan; they become operational here.

    Raises:
        NodeError: a node refuses a required write.
    """

    def __init__(self, port: Port, plan: Plan, *, world: World, tactile: TactileReceiver | None, **more: Any) -> None:
        port.clock.sleep_until_ns(port.clock.now_ns() + round(SECOND_ANSWER_S * 1e9))  # as bring-up for second boot-ups
        super().__init__(port, plan, tactile=tactile, **more)
        drives, carrier = self._drives, self._intake.carrier
        self._clock, self._first_look_ns = port.clock, plan.budget.looks_ns[0]
        self._counter = 0
        self._commands = drives.targets.commands if drives is not None else tuple
        takes = {} if drives is None else dict.fromkeys((drive.node_id for drive in plan.setup.drives), drives.take)
        if carrier is not None and plan.setup.carrier is not None:
            takes[plan.setup.carrier.node_id] = carrier.take
        self._see = tactile.put if tactile is not None else nothing
        self._shape = plan.setup.array.pad.shape if plan.setup.array is not None else (0, 0)
        self._nodes, self._recorder = world.nodes, world.recorder
        by_id, of_drives = {node.node_id: node for node in self._nodes}, [drive.node_id for drive in plan.setup.drives]
        self._start({setup.node_id: setup for setup in plan.nodes}, of_drives, port.clock.now_ns())
        self._stations = [(node.core, node.pdos.exchange, takes.get(node.node_id)) for node in self._nodes]
        self._rpdos: dict[int, list[tuple[NodeCore, Rpdo]]] = {}
        for node_id in of_drives:
            for pdo in plan.pdos_of(node_id, "rpdo"):
                rpdo = by_id[node_id].pdos.rpdo(pdo.cob_id)
                self._rpdos.setdefault(pdo.cob_id, []).append((by_id[node_id].core, rpdo))

    def _start(self, setups: Mapping[int, NodeConfiguration], of_drives: Sequence[int], t_ns: int) -> None:
        """Power on, configure and start all nodes, so that they are operational at `t_ns`.

        A drive does not watch for its master, which is in the same process and cannot fall silent.
        """
        power_on_ns = t_ns - max(node.core.quirks.boot_ns for node in self._nodes)
        for node in self._nodes:
            node.start(power_on_ns)
            node.advance(t_ns)
            configure(node, setups[node.node_id])
            if node.node_id in of_drives:
                cast("DriveApplication", node.application).parts.parameters.patience_ns = 0
            if isinstance(node.application, TactileApplication):
                node.application.publish = partial(self._publish, node)
        for node in self._nodes:
            self._pass_on(node.receive(*pack_nmt(NmtCommand.START, node.node_id), t_ns), t_ns)

    def send_sync(self, counter: int | None) -> None:
        self.sync_ns = self._clock.now_ns()
        self._advance(self.sync_ns)
        self._counter = counter or 0

    def collect(self) -> None:
        """Every node latches its targets and samples; the drives, and the encoder of the carrier, send their TPDOs."""
        t_ns, counter = self.sync_ns, self._counter
        for core, exchange, take in self._stations:
            core.now_ns = t_ns
            filled = exchange(t_ns, counter)
            if take is not None:
                for cob_id, values in filled:
                    take(cob_id, values, t_ns)
            if core.out:
                frames, core.out = core.out, []
                self._pass_on(frames, t_ns)
        if self._recorder is not None:
            self._recorder.receive(SYNC_ID, bytes((counter,)), t_ns)
        look_ns = t_ns + self._first_look_ns
        self._clock.sleep_until_ns(look_ns)
        self._advance(look_ns)

    def send_commands(self) -> None:
        """Give the RPDOs to the drives; each part of one is for one drive."""
        t_ns = self.sync_ns + self._first_look_ns
        for cob_id, _, parts in self._commands():
            for (core, rpdo), values in zip(self._rpdos[cob_id], parts, strict=True):
                core.now_ns = t_ns
                rpdo.take(values)

    def _advance(self, t_ns: int) -> None:
        """Let every node do what is due up to and at `t_ns`, in the order of time."""
        nodes = self._nodes
        while True:
            first = min([due for node in nodes if (due := node.next_deadline_ns) is not None], default=t_ns + 1)
            if first > t_ns:
                return
            for node in nodes:
                if node.next_deadline_ns == first:
                    self._pass_on(node.advance(first), first)

    def _pass_on(self, frames: Sequence[Frame], t_ns: int) -> None:
        for can_id, data in frames:
            self._watch.push(can_id, data, t_ns)

    def _publish(self, node: SlaveNode, header: TactileHeader, content: NDArray[np.uint8] | Features) -> None:
        self._see(tactile_frame(header, content, self._shape, node.core.now_ns))
