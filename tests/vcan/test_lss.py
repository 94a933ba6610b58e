"""Node ids over LSS on a real interface: `canprobe scan --lss` and the blank nodes of another process."""

from __future__ import annotations

import json
import signal
from typing import Any

import pytest

pytestmark = pytest.mark.vcan
ON_VCAN0 = ("--bus", "socketcan", "--channel", "vcan0")


def served(bench: Any, blank: str) -> Any:
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
