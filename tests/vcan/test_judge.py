"""`canprobe judge` on a real vcan0: masters in other processes, with the frames that they send."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from canprobe.cli import main
from canprobe.fieldbus.eds.packaged import eds_path

pytestmark = pytest.mark.vcan
SUPPORT = Path(__file__).parents[1] / "support"
EDS = str(eds_path("puma260_joint"))
WORDS = ("--passive", "--json", "--without", "32,33,34")
"""A virtual machine that stands still raises the rules on times."""


def found(capsys: Any, channel: str, script: str, *words: str) -> tuple[int, set[str]]:
    command = [sys.executable, str(SUPPORT / script), *words]
    status = main(["judge", "--eds", EDS, "--node-id", "5", "--channel", channel, *WORDS, "--", *command])
    document = json.loads(capsys.readouterr().out)
    for row in document["rows"]:
        if row["verdict"] == "FAIL":
            print(row["name"], row["detail"], *row["came"][:6], sep="\n  ", file=sys.stderr)
    return status, {row["name"] for row in document["rows"] if row["verdict"] == "FAIL"}


def test_a_small_master_on_python_can_jumps(vcan0: str, capsys: Any) -> None:
    status, names = found(capsys, vcan0, "small_master.py", "5", "socketcan", vcan0)
    assert (status, names) == (1, {"01 target at enable", "06 first RPDO zero-filled"})


@pytest.mark.slow(reason="three ways of another's master; the default judges a small one")
@pytest.mark.parametrize(
    ("way", "expected"),
    [
        ("cyclic", {"01 target at enable", "06 first RPDO zero-filled", "15 targets after a fault"}),
        ("direct", {"07 RPDO never sent"}),
        ("event", {"06 first RPDO zero-filled", "18 no watchdog"}),
    ],
)
def test_base_node_402_in_its_usual_ways(vcan0: str, capsys: Any, way: str, expected: set[str]) -> None:
    """What docs/judge.md says of canopen 2.4.1."""
    status, names = found(capsys, vcan0, "base_node_402.py", way, "5", EDS, vcan0)
    assert status == 1
    assert names >= expected
