"""The cycle of a cell written with plain canopen-python, as a reference: its Network, its threads, its PDO objects.

SYNC, wait for six TPDOs, read statusword, position and torque, write the targets, transmit six RPDOs; read the
sensor's PDOs. Nothing is computed: the targets are the first positions.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from time import process_time
from typing import Any

import canopen
import numpy as np

from canprobe.cell.planning.configuration import NodeSetup, make_setups
from canprobe.cell.planning.model import Plan
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.protocol.sync import SyncCounter
from canprobe.lab.studies.cycle_times import CycleTimes, processor_share, woken
from canprobe.lab.studies.result import CHANNEL

_ENABLING = (6, 7, 15)
_CYCLES_A_STEP = 20
_WAIT_SHARE = 0.6
"""Longest wait for TPDOs over the period, as in canprobe's cycle."""


def run_plain(plan: Plan, seconds: float) -> CycleTimes:
    """Bring the nodes of a plan with drives 1–6 up, run the cycle for a time, stop them."""
    network = canopen.Network()
    network.connect(interface="socketcan", channel=CHANNEL)
    try:
        nodes = [_configured(network, setup) for setup in make_setups(plan)]
        with _operational(network):
            cycle = _PlainCycle(network, plan, nodes)
            for word in _ENABLING:
                cycle.run(word, _CYCLES_A_STEP)
            return cycle.times(seconds)
    finally:
        network.disconnect()


def _configured(network: canopen.Network, setup: NodeSetup) -> Any:
    node: Any = network.add_node(setup.node_id, setup.dictionary)
    for write in setup.writes:
        variable = setup.dictionary.get_variable(write.index, write.subindex)
        assert variable is not None
        node.sdo.download(write.index, write.subindex, variable.encode_raw(write.value))
    node.tpdo.read()
    node.rpdo.read()
    return node


@contextmanager
def _operational(network: canopen.Network) -> Iterator[None]:
    network.nmt.send_command(1)
    try:
        yield
    finally:
        network.nmt.send_command(0x80)


class _PlainCycle:
    def __init__(self, network: canopen.Network, plan: Plan, nodes: Sequence[Any]) -> None:
        drive_ids = {node.node_id for node in plan.nodes if node.kind == "drive"}
        self._network, self._plan = network, plan
        self._drives = [node for node in nodes if node.id in drive_ids]
        self._maps = [m for node in nodes if node.id not in drive_ids for m in node.tpdo.values() if m.enabled]
        self._sync = SyncCounter(plan.sync.overflow)
        self._held: dict[int, int] = {}
        self.missed = 0
        self._clock = MonotonicClock()

    def run(self, word: int, cycles: int) -> list[int]:
        """Run some cycles; returns the lateness of each SYNC, ns."""
        period_ns = self._plan.sync.period_ns
        lateness: list[int] = []
        for deadline_ns in woken(self._clock, period_ns, cycles, lateness):
            self._once(word, deadline_ns + int(_WAIT_SHARE * period_ns))
        return lateness

    def _once(self, word: int, until_ns: int) -> None:
        maps = [drive.tpdo[1] for drive in self._drives]
        for tpdo in maps:
            tpdo.is_received = False
        self._network.sync.transmit(self._sync.next())
        for tpdo in maps:
            with tpdo.receive_condition:
                while not tpdo.is_received and (left_ns := until_ns - self._clock.now_ns()) > 0:
                    tpdo.receive_condition.wait(left_ns * 1e-9)
            self.missed += not tpdo.is_received
        for drive, tpdo in zip(self._drives, maps, strict=True):
            _, position, *_ = [variable.raw for variable in tpdo]
            self._held.setdefault(drive.id, position)
            controlword, target = list(drive.rpdo[1])
            controlword.raw = word
            target.raw = self._held[drive.id]
            drive.rpdo[1].transmit()
        for tpdo in self._maps:
            for variable in tpdo:
                _ = variable.raw

    def times(self, seconds: float) -> CycleTimes:
        """Run the cycle for some time."""
        period_ns, clock = self._plan.sync.period_ns, self._clock
        self.missed = 0
        begin_ns, used_s = clock.now_ns(), process_time()
        lateness: list[int] = []
        while (left_ns := seconds * 1e9 - (clock.now_ns() - begin_ns)) > 0:
            lateness += self.run(_ENABLING[-1], min(200, int(left_ns / period_ns) + 1))
        passed_s = (clock.now_ns() - begin_ns) * 1e-9
        late, share = np.array(lateness, np.int64), processor_share(used_s, passed_s)
        return CycleTimes(period_ns, late, passed_s, missed=self.missed, processor_share=share)
