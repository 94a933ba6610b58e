"""The emulated encoder of the carrier: a CiA 406 node that samples the plant at SYNC."""

from __future__ import annotations

from canprobe.cell.planning.pdos import ENCODER_POSITION
from canprobe.cell.plant.plant import Plant
from canprobe.cell.scene.setup import Carrier
from canprobe.fieldbus.node.slave_node import Application, SlaveNode


class EncoderApplication(Application):
    """The encoder function of one node.

    Args:
        plant: shared with the other nodes.
        carrier: the carrier; it gives the units.
        counts_range: number of counts after which the position value begins again.
    """

    def __init__(self, plant: Plant, carrier: Carrier, counts_range: int) -> None:
        self._plant, self._carrier, self._range = plant, carrier, counts_range

    def attach(self, node: SlaveNode) -> None:
        self._node = node
        node.pdos.on_trigger(ENCODER_POSITION[0], self._sample)

    def _sample(self, t_ns: int) -> None:
        self._plant.begin(t_ns)
        self._plant.advance(t_ns)
        counts = self._carrier.zero + round(self._carrier.units * self._plant.carrier_position)
        self._node.dictionary.put(*ENCODER_POSITION, counts % self._range)
