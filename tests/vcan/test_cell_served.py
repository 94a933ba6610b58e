"""Emulated nodes in a process of their own, served to whoever comes."""

from __future__ import annotations

import json
import signal
from typing import Any

import canopen
import pytest

from canprobe.cli import main
from canprobe.fieldbus.eds.packaged import eds_path
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of

pytestmark = pytest.mark.vcan
NODES = (1, 2, 3, 4, 5, 6, 16)
ON_VCAN0 = ("--bus", "socketcan", "--channel", "vcan0")


@pytest.fixture(scope="module")
def served(start_shared: Any) -> Any:
    """`canprobe emulate cylinder`, started once; the last test of the module ends it."""
    return start_shared("emulate", "cylinder", "--channel", "vcan0").until_told("serving nodes")


def test_scan_lists_the_nodes_with_their_identity(served: Any, bench: Any) -> None:
    command = bench.start("scan", "--channel", "vcan0", "--json")
    assert command.end(0) == []
    nodes = {node["node_id"]: node for node in json.loads(command.out)}
    assert tuple(nodes) == NODES
    for node_id, node in nodes.items():
        eds: Any = canopen.import_od(str(eds_path("tactile_array" if node_id == 16 else "puma260_joint")), node_id)
        for subindex, name in enumerate(("vendor_id", "product_code", "revision_number"), start=1):
            assert node[name] == eds[0x1018][subindex].default, (node_id, name)
        assert node["device_name"] == eds[0x1008].default


def test_a_busy_node_id_is_refused(served: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["emulate", "cylinder", "--channel", "vcan0", "--nodes", "16,5"]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("canprobe: node 5: is on vcan0 already; its id is busy")


def test_drives_stop_by_themselves_when_their_master_is_killed(served: Any, bench: Any) -> None:
    command = bench.start("up", bench.scene("free", emulated=False), *ON_VCAN0)
    bench.bus.until_enabled(6, by=command)
    command.send(signal.SIGKILL)
    emergencies: set[int] = set()

    def complete(frame: tuple[int, bytes, int]) -> bool:
        if frame[0] in range(0x81, 0x87) and frame[1][:2] != bytes(2):
            emergencies.add(frame[0])
        return len(emergencies) == 6

    bench.bus.until(complete, served)
    answers: dict[int, bytes] = {}

    def all_off(frame: tuple[int, bytes, int]) -> bool:
        if frame[0] in range(0x581, 0x587):
            answers[frame[0] - 0x580] = frame[1][4:6]
        elif frame[0] == 0x701:  # ask once a heartbeat
            bench.bus.port.send_batch([(0x600 + n, bytes.fromhex("4041600000000000")) for n in NODES[:6]])
        states = [state_of(int.from_bytes(word, "little")) for word in answers.values()]
        return len(states) == 6 and not POWERED_STATES.intersection(states)

    bench.bus.until(all_off, served)


def test_serving_ends_with_an_interrupt(served: Any) -> None:
    served.send(signal.SIGINT)
    (line,) = served.end(0)
    assert line == "serving nodes 1, 2, 3, 4, 5, 6, 16 on vcan0; Ctrl-C stops them"
