"""Voltage and temperature of the drives, read over SDO beside the cycle: one entry at a time, seldom, and of no weight.

Only who shows a cell to a person serves it. A request goes out behind the commands of a cycle; on the bus it has to
wait for every PDO.
"""

from __future__ import annotations

from collections import deque

from canopen.objectdictionary import ODVariable
from canopen.objectdictionary.datatypes import UNSIGNED32

from canprobe.cell.master.node_bringup import read_entry
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.node_configuration import NodeConfiguration
from canprobe.errors import NodeError
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.sdo import Dialogue, Dialogues

READ_EVERY_NS = 250_000_000
"""Time from one request to the next."""
DC_LINK = 0x6079
"""DC link circuit voltage (CiA 402-2), in mV; an entry of another type has a unit of its maker's own."""


class Readings:
    """Reads what tells the health of the drives, in turn.

    Args:
        network: network of the cell, which its cycle feeds.
        plan: plan of the cell.

    Attributes:
        values: the last values by node id and name, `voltage_v` and `temperature_c`.
        remarks: what a node did not give; it is not asked for that again.
    """

    def __init__(self, network: PumpedNetwork, plan: Plan) -> None:
        self._network, self._timeout_s = network, plan.setup.bring_up.sdo_s
        self._waiting: deque[tuple[NodeConfiguration, str, int, int, float]] = deque()
        self._held: Dialogues | None = None
        self._due_ns = 0
        self.values: dict[int, dict[str, float]] = {}
        self.remarks: list[str] = []
        temperature = None if plan.setup.arm is None else plan.setup.arm.temperature
        for setup in plan.nodes:
            if setup.mode is None:
                continue
            link = setup.dictionary.get(DC_LINK)
            if isinstance(link, ODVariable) and link.data_type == UNSIGNED32:
                self._waiting.append((setup, "voltage_v", DC_LINK, 0, 1e-3))
            if temperature is not None:
                self._waiting.append((setup, "temperature_c", *temperature))

    def serve(self, *, begins: bool) -> None:
        """Take an answer, or ask for the next entry; called once a cycle, behind its commands.

        Args:
            begins: whether a request may go out: not where another dialogue with a node begins at once.
        """
        now_ns = self._network.port.clock.now_ns()
        if self._held is not None:
            self._held.serve()
            if not self._held.waiting:
                self._held.__exit__()
                self._held = None
        elif begins and self._waiting and now_ns >= self._due_ns:
            self._due_ns = now_ns + READ_EVERY_NS
            setup, name, index, subindex, unit = entry = self._waiting.popleft()

            def read() -> Dialogue:
                try:
                    value = yield from read_entry(setup, index, subindex)
                except NodeError as error:
                    self.remarks.append(f"{error}; it is not read again")
                    self.values.get(setup.node_id, {}).pop(name, None)
                else:
                    self.values.setdefault(setup.node_id, {})[name] = unit * value
                    self._waiting.append(entry)

            self._held = Dialogues(self._network, {setup.node_id: read()}, timeout_s=self._timeout_s)
            # not by `with`: the dialogue goes on over several cycles, of which each only serves it
            self._held.__enter__()
