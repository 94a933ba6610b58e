"""Node ids over LSS on a real interface: `canprobe scan --lss` and the blank nodes of another process."""

from __future__ import annotations

import json
import signal
from typing import Any

import pytest

pytestmark = pytest.mark.vcan
ON_VCAN0 = ("--bus", "socketcan", "--channel", "vcan0")


def served(bench: Any, blank: str = "3,4") -> Any:
    nodes = ("--nodes", "2-4", "--without-id", blank, "--store", "nodes")
    return bench.start("emulate", "free", "--channel", "vcan0", *nodes).until_told("serving nodes")


def scan(bench: Any, *words: str) -> Any:
    command = bench.start("scan", "--lss", *words, *ON_VCAN0, "--json")
    assert command.end(0) == []
    return json.loads(command.out)


def test_a_blank_node_gets_its_id(bench: Any) -> None:
    nodes = served(bench, "4")
    done = scan(bench, "--assign", "4=44")
    assert [(one["node_id"], one["serial_number"], one["stored"]) for one in done["assigned"]] == [(44, 4, True)]
    assert [(node["node_id"], node["serial_number"]) for node in done["nodes"]] == [(2, 2), (3, 3), (44, 4)]
    assert done["unconfigured"] == []
    nodes.send(signal.SIGINT)
    nodes.wait()


@pytest.mark.slow(reason="three scans and a restart on a real bus; without one in tests/cli/test_scan_lss.py")
def test_blank_nodes_keep_their_ids(bench: Any) -> None:
    nodes = served(bench)
    found = scan(bench)
    assert [node["node_id"] for node in found["nodes"]] == [2]
    assert [blank["serial_number"] for blank in found["unconfigured"]] == [3, 4]
    scan(bench, "--assign", "4=44")
    nodes.send(signal.SIGINT)
    nodes.wait()
    again = served(bench)
    assert [node["node_id"] for node in scan(bench, "--assign", "3")["nodes"]] == [2, 3, 44]
    again.send(signal.SIGINT)
    again.wait()
