"""Emulated nodes in a process of their own, served to whoever comes: `canprobe`, or a master that is not ours."""

from __future__ import annotations

import json
import signal
import threading
from typing import Any

import canopen
import pytest
from patience import patience_s

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


def test_a_canopen_master_that_is_not_ours(served: Any, vcan0: str) -> None:
    network = canopen.Network()
    network.connect(interface="socketcan", channel=vcan0)
    try:
        node: Any = network.add_node(3, str(eds_path("puma260_joint")))
        node.sdo.RESPONSE_TIMEOUT = 2.0
        for subindex in (1, 2, 3):
            assert node.sdo[0x1018][subindex].raw == node.object_dictionary[0x1018][subindex].default
        node.sdo[0x1017].raw = 50
        assert node.nmt.wait_for_heartbeat(timeout=patience_s(10)) == "PRE-OPERATIONAL"
        node.nmt.state = "OPERATIONAL"
        while node.nmt.wait_for_heartbeat(timeout=patience_s(10)) != "OPERATIONAL":
            pass
        node.sdo[0x6040].raw = 0x06
        assert node.sdo[0x6041].raw & 0x6F == 0x21, "ready to switch on"
        booted = threading.Event()
        network.subscribe(0x703, lambda can_id, data, t_s: booted.set() if data == b"\0" else None)
        node.nmt.state = "RESET"
        assert booted.wait(patience_s(10)), "the boot-up"
    finally:
        network.disconnect()


@pytest.mark.slow(reason="a second touch on a real bus; the foreign drives are not emulated either")
def test_a_run_that_emulates_nothing(served: Any, bench: Any) -> None:
    scene = bench.scene("press", emulated=False)
    command = bench.start("run", scene, *ON_VCAN0, "--duration", 1, "--out", "results")
    (line,) = command.end(0)
    assert line.startswith("warning: sensor.calibration: the array measures in nominal newtons")
    results = bench.results("results")
    assert not (bench.folder / "results" / "truth.npz").exists(), "nothing knows the truth about real nodes"
    assert results.summary["completed"] is True
    assert results.summary["contact"]["force_target_n"] == 2.0
    assert results.summary["contact"]["force_measured_rms_error_n"] < 1.0
    bench.assert_left_safe(results.last, *NODES)
    assert served.running


def test_a_busy_node_id_is_refused(served: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["emulate", "cylinder", "--channel", "vcan0", "--nodes", "16,5"]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("canprobe: node 5: is on vcan0 already; its id is busy")


@pytest.mark.slow(reason="starts a run to see it refused; emulate is refused alike")
def test_a_run_whose_emulated_nodes_are_there_already(served: Any, bench: Any) -> None:
    (line,) = bench.start("run", "press", *ON_VCAN0, "--out", "results").end(3)
    assert line.startswith("canprobe: node 1: is on vcan0 already; its id is busy")
    assert "take them as real ones: " in line and "--set arm.emulated=false --set sensor.emulated=false" in line
    assert "--nodes" not in line
    assert served.running


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
