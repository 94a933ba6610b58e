"""A cell on a real interface that recovers: from a node without power, and from an interface that was down."""

from __future__ import annotations

import signal
from typing import Any

import pytest
from rights import type_as_root
from waiting import wait_until

pytestmark = pytest.mark.vcan
ON_VCAN0 = ("--bus", "socketcan", "--channel", "vcan0")


def link(state: str) -> None:
    type_as_root("ip", "link", "set", "vcan0", state)


@pytest.mark.slow(reason="two recoveries on a real bus")
def test_a_cell_that_recovers_outlives_a_power_cycle_and_an_interface_that_was_down(bench: Any) -> None:
    command = bench.start("up", bench.scene("free"), *ON_VCAN0, "--recover", "--verbose")
    command.until_told("the cell is up")
    thrown = bench.start("inject", "--channel", "vcan0", "node 3: reboot for 2 s")
    thrown.end(0)
    command.until_told("lost: node 3").until_told("wait: node 3 not there").until_told("the cell is back after")
    bench.bus.until_enabled(3, by=command)
    bench.bus.port.close()
    link("down")
    command.until_told("wait: vcan0: interface is down")
    link("up")
    wait_until(lambda: command.err.count("the cell is back after") == 2, lambda: command.running, lambda: command.err)
    bench.bus = type(bench.bus)()
    bench.bus.until_enabled(6, by=command)
    command.send(signal.SIGINT)
    command.end(0)
    while bench.bus.hear():
        pass
    bench.assert_left_safe(bench.bus.last, 1, 2, 3, 4, 5, 6)
