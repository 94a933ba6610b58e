"""Nodes under conformance tests, and the table of all points at the end."""

from __future__ import annotations

from typing import Any

import pytest
from conformance_bench import Bench, connect, pytest_terminal_summary  # noqa: F401

from canprobe.fieldbus import load_eds
from canprobe.fieldbus.drive import make_drive_node


@pytest.fixture
def tiny(connect: Any, make_bench: Any) -> Bench:
    """The tiny node 5 of `node_bench`, booted."""
    return connect(make_bench().node).boot()


@pytest.fixture
def drive(connect: Any, plant: Any) -> Bench:
    """Drive 1, booted: CSP, interpolation over 100 ms so that a bench that is slow loses no cycle."""
    bench = connect(make_drive_node(load_eds("puma260_joint", 1), 1, 0, plant)).boot()
    bench.set((0x6060, 0, 8, 1), (0x1019, 0, 240, 1), (0x60C2, 1, 100, 1), (0x60C2, 2, -3, 1))
    return bench
